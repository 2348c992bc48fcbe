"""Forces on node sets and nodes over time: all tables are evaluated in one loop, all forces added in another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..case.files import Forces, read_forces
from ..case.tables import LoadFile
from ..errors import InputError
from ..parallel.agreement import on_root
from ..registry import nearest
from .compiled import kernel
from .time_tables import Group, TimeTables, grouped

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["NodalLoads"]


@kernel
def _add_forces(first, members, forces, columns, values, out):
    """Add force k (3,) times its value to the nodes ``members[first[k]:first[k + 1]]`` of ``out``."""
    for k in range(len(forces)):
        value = values[columns[k]]
        x, y, z = forces[k, 0] * value, forces[k, 1] * value, forces[k, 2] * value
        for m in range(first[k], first[k + 1]):
            i = members[m]
            out[i, 0] += x
            out[i, 1] += y
            out[i, 2] += z


class NodalLoads:
    """All entries of ``[[load]]`` on this rank's nodes. Construction is collective if there are files.

    Attributes
    ----------
    any : whether there are any in the model
    steady : whether all of them are constant
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.any = bool(case.load)
        self._groups: list[Group] = []
        self._members: list[np.ndarray] = []
        self._forces: list[np.ndarray] = []
        self._columns: list[int] = []
        plain = [load for load in case.load if not isinstance(load, LoadFile)]
        tables = [(np.array(load.table), load.interpolation == "smooth") for load in plain if load.table is not None]
        self._groups, columns = grouped(tables)
        self._width = sum(group.values.shape[1] for group in self._groups)
        left = iter(columns.tolist())
        for index, load in enumerate(case.load):
            if isinstance(load, LoadFile):
                key = f'{case.source}: load[{index}].file = "{load.file}"'
                self._add_file(key, load, nodes, mesh)
            else:
                column = -1 if load.table is None else next(left)
                self._add(nodes[load.node_set], np.array(load.force), column)
        self.steady = not self._groups
        self._tables = TimeTables(self._groups)
        sizes = np.array([len(each) for each in self._members], dtype=np.int64)
        first = np.append(0, np.cumsum(sizes))
        members = np.concatenate([np.zeros(0, dtype=np.int64), *self._members])
        forces = np.array(self._forces).reshape(-1, 3)
        # forces without a table are multiplied by the last value
        which = np.array(self._columns, dtype=np.int64)
        which[which < 0] = self._width
        self._arguments = first, members, forces, which
        self._values = np.empty(self._width + 1)

    def _add(self, members: np.ndarray, force: np.ndarray, column: int) -> None:
        self._members.append(np.asarray(members, dtype=np.int64))
        self._forces.append(force)
        self._columns.append(column)

    def _add_file(self, key: str, load: LoadFile, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        content = on_root(mesh.comm, _read, key, load)
        members = _members(key, content, nodes, mesh)
        values = content.values
        if len(content.times) == 1 and (values == 1.0).all():
            columns = np.full(len(content.columns), -1)  # constant: with a load factor they grow with it
        else:
            used = [e for e, member in enumerate(content.members.tolist()) if len(members[member])]
            mine = np.unique(content.columns[used])  # of the columns, those of this rank
            place = np.full(values.shape[1], -1)
            place[mine] = self._width + np.arange(len(mine))
            columns = place[content.columns]
            self._groups.append(Group(load.time_scale * content.times, values[:, mine], load.interpolation == "smooth"))
            self._width += len(mine)
        for member, column, force in zip(content.members.tolist(), columns.tolist(), content.forces, strict=True):
            if len(members[member]):
                self._add(members[member], load.scale * force, column)

    def add(self, time: float, constant: float, out: np.ndarray) -> None:
        """Add the forces at a time [s] to ``out`` (owned, 3) [N]; those without a table times ``constant``."""
        self._tables.at(time, self._values)
        self._values[self._width] = constant
        _add_forces(*self._arguments, self._values, out)


def _read(key: str, load: LoadFile) -> Forces:
    try:
        return read_forces(Path(load.file), load.digest)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def _members(key: str, content: Forces, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> list[np.ndarray]:
    """Return the owned local indices of each target."""
    nothing = np.zeros(0, dtype=np.int64)
    owned = mesh.node_ids[: mesh.n_owned]
    order = np.argsort(owned)
    numbers = np.array([target for target in content.targets if isinstance(target, int)], dtype=np.int64)
    outside = numbers[(numbers < 0) | (numbers >= mesh.n_nodes)]
    if len(outside):
        raise InputError(f"{key}: there is no node {outside[0]}: the mesh has the nodes 0 to {mesh.n_nodes - 1}")
    places = np.searchsorted(owned, numbers, sorter=order) if len(owned) else np.zeros(len(numbers), dtype=np.int64)
    found, k = [], 0
    for target in content.targets:
        if isinstance(target, str):
            if target not in nodes:
                raise InputError(f"{key}: there is no node set {target!r}{nearest(target, list(nodes))}")
            found.append(nodes[target])
            continue
        at = order[places[k]] if places[k] < len(owned) else -1
        found.append(np.array([at]) if at >= 0 and owned[at] == target else nothing)
        k += 1
    return found
