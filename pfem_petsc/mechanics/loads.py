"""External forces: gravity, nodal loads over time, and forces that depend on the motion, such as wind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..case.files import Forces, read_forces
from ..case.tables import LoadFile
from ..errors import InputError, raised
from ..parallel.agreement import on_root, outcome
from ..registry import nearest
from .compiled import kernel, record
from .motion import Group, Table, TimeTables, grouped

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .bars import Bars
    from .mass import Inertia


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


@record
class LoadSchedule(NamedTuple):
    """Loads and gravity that vary, at the times of some steps.

    Attributes
    ----------
    gravity : (steps, 3) [m/s2]; (0, 3) if neither loads nor gravity vary
    nodes : (k,) whose forces vary: all if gravity does, else those with loads
    values : (steps, k) of tables, and 1 for forces without one
    first, members, forces, columns : arguments of :func:`_add_forces`
    """

    gravity: np.ndarray
    nodes: np.ndarray
    values: np.ndarray
    first: np.ndarray
    members: np.ndarray
    forces: np.ndarray
    columns: np.ndarray


_NONE = np.empty(0, dtype=np.int64)
_CONSTANT = LoadSchedule(np.empty((0, 3)), _NONE, np.empty((0, 1)), _NONE, _NONE, np.empty((0, 3)), _NONE)


@kernel
def set_forces(step, loads, mass, out):
    """Write the forces (n, 3) [N] at a step of a :class:`LoadSchedule`, of the nodes where it has written others."""
    for i in loads.nodes:
        for c in range(3):
            out[i, c] = mass[i] * loads.gravity[step, c]
    _add_forces(loads.first, loads.members, loads.forces, loads.columns, loads.values[step], out)


class NodalLoads:
    """All entries of ``[[load]]`` on this rank's nodes. Construction is collective if there are files.

    Attributes
    ----------
    any : whether there are any in the model
    steady : whether all of them are constant
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.any = bool(case.load)
        self._entries: list[tuple[np.ndarray, np.ndarray, int]] = []  # nodes, force, and column of its factor
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
                self._entries.append((nodes[load.node_set], np.array(load.force), column))
        self.steady = not self._groups
        self._tables = TimeTables(self._groups)
        first = np.cumsum([0, *(len(members) for members, _, _ in self._entries)])
        members = np.concatenate([np.zeros(0, dtype=np.int64), *(members for members, _, _ in self._entries)])
        forces = np.array([force for _, force, _ in self._entries]).reshape(-1, 3)
        # forces without a table are multiplied by the last value
        which = np.array([column if column >= 0 else self._width for _, _, column in self._entries], dtype=np.int64)
        self.arguments = first, members, forces, which
        self._values = np.empty(self._width + 1)

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
                self._entries.append((members[member], load.scale * force, column))

    def values(self, time: float, constant: float) -> np.ndarray:
        """Values (k,) of the tables at a time [s], and ``constant``; the array is used again."""
        self._tables.at(time, self._values)
        self._values[self._width] = constant
        return self._values

    def add(self, time: float, constant: float, out: np.ndarray) -> None:
        """Add the forces at a time [s] to ``out`` (owned, 3) [N]; those without a table times ``constant``."""
        _add_forces(*self.arguments, self.values(time, constant), out)


def _read(key: str, load: LoadFile) -> Forces:
    try:
        return read_forces(Path(load.file), load.digest)
    except InputError as error:
        raise InputError(f"{key}: {error}") from error


def _members(key: str, content: Forces, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> list[np.ndarray]:
    """Return the owned local indices of each target."""
    numbers = np.array([target for target in content.targets if isinstance(target, int)], dtype=np.int64)
    outside = numbers[(numbers < 0) | (numbers >= mesh.n_nodes)]
    if len(outside):
        raise InputError(f"{key}: there is no node {outside[0]}: the mesh has the nodes 0 to {mesh.n_nodes - 1}")
    for target in content.targets:
        if isinstance(target, str) and target not in nodes:
            raise InputError(f"{key}: there is no node set {target!r}{nearest(target, list(nodes))}")
    owned = mesh.node_ids[: mesh.n_owned]
    mine = np.flatnonzero(np.isin(owned, numbers))
    known = nodes | dict(zip(owned[mine].tolist(), mine[:, None], strict=True))
    return [known.get(target, mine[:0]) for target in content.targets]


@dataclass(frozen=True)
class ForceState:
    """What a force depends on, of the nodes that this rank owns.

    Attributes
    ----------
    position : (owned, 3) [m]
    v : (owned, 3) velocities [m/s]; also ``velocity``
    nodes : (owned,) node numbers of the mesh
    node_sets : rows of the nodes of each node set, by name
    """

    position: np.ndarray
    v: np.ndarray
    nodes: np.ndarray
    node_sets: Mapping[str, np.ndarray]

    @property
    def velocity(self) -> np.ndarray:
        """Velocities (owned, 3) [m/s]."""
        return self.v


class FunctionForce:
    """The force that a function of time and state returns.

    Attributes
    ----------
    failure : why the last force could not be evaluated on this rank, None if it could
    """

    def __init__(self, function: Callable[[float, ForceState], Any], mesh: DistributedMesh) -> None:
        self.function, self.failure = function, None
        self._shape, self._comm = (mesh.n_owned, 3), mesh.comm

    def add(self, time: float, state: ForceState, out: np.ndarray) -> None:
        """Add the force at a time [s] to ``out`` (owned, 3) [N]; what is wrong with it becomes the failure, so that no
        rank is left alone. Collective, as the function may be."""
        error: BaseException | None = None
        try:
            force = np.asarray(self.function(time, state), dtype=np.float64)
        except BaseException as caught:  # noqa: BLE001 - of a user; the other ranks would wait
            error = caught
        if outcome(self._comm, error is not None) is None:
            raise error
        if error is not None:
            self.failure = raised(error)
            return
        if force.shape != self._shape:
            self.failure = (
                f"returned an array {force.shape}: expected {self._shape}, a force for each node of this rank"
            )
        elif not np.isfinite(force).all():
            node = state.nodes[np.flatnonzero(~np.isfinite(force).all(axis=1))[0]]
            self.failure = f"returned a force on node {node} that is not finite"
        else:
            out += force


@kernel
def _add_drag(bars, x, v, factor, wind, owned, out):
    """Add the drag of bars at positions and velocities (local, 3) to the forces ``out`` (owned, 3) of their ends."""
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        tx, ty, tz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        length = (tx * tx + ty * ty + tz * tz) ** 0.5
        if factor[k] == 0.0 or length == 0.0:
            continue
        tx, ty, tz = tx / length, ty / length, tz / length
        wx = wind[0] - 0.5 * (v[a, 0] + v[b, 0])
        wy = wind[1] - 0.5 * (v[a, 1] + v[b, 1])
        wz = wind[2] - 0.5 * (v[a, 2] + v[b, 2])
        along = wx * tx + wy * ty + wz * tz
        wx, wy, wz = wx - along * tx, wy - along * ty, wz - along * tz
        f = factor[k] * length * (wx * wx + wy * wy + wz * wz) ** 0.5
        for end in (a, b):
            if end < owned:
                out[end, 0] += f * wx
                out[end, 1] += f * wy
                out[end, 2] += f * wz


class Wind:
    """The drag of all bars.

    Attributes
    ----------
    held : (3,) velocity at the start of a stage that does not give its own [m/s], None for none
    """

    failure = None

    def __init__(self, case: Case, bars: Bars) -> None:
        wind = case.wind
        self.held: np.ndarray | None = None
        self._holds = case.holds("wind")
        self._table = Table(wind.velocity if wind.varies else [(0.0, *wind.velocity)], wind.interpolation == "smooth")
        mesh = bars.mesh
        self._bars, self._mesh, self._rate = bars, mesh, 0.0
        self._factor = np.zeros(len(mesh.bars))
        for block in bars.blocks:
            if block.section not in case.section:  # springs and dashpots
                continue
            section, part = case.section[block.section], slice(block.start, block.stop)
            width = section.cross_section(block.area).width
            coefficient = wind.drag_coefficient if section.drag_coefficient is None else section.drag_coefficient
            self._factor[part] = 0.25 * wind.density * coefficient * width
            # dF/dw over the mass of the bar, for w = 1 m/s
            most = float(np.max(4.0 * self._factor[part] / (block.density * block.area), initial=0.0))
            self._rate = max(self._rate, most)
        self._x, self._v = np.zeros((mesh.n_local, 3)), np.zeros((mesh.n_local, 3))

    def velocity(self, time: float) -> np.ndarray:
        """Return the velocity of the wind (3,) [m/s] at a time [s]."""
        if self._holds and self.held is not None:
            return self.held
        return self._table(time)

    def add(self, time: float, state: ForceState, out: np.ndarray) -> None:
        """Add the drag at a time [s] to ``out`` (owned, 3) [N]. Collective."""
        owned = self._mesh.n_owned
        for local, given in ((self._x, state.position), (self._v, state.v)):
            local[:owned] = given
            self._mesh.update_ghosts(local)
        # the share of a bar that is left has its drag: the ends of a broken bar may be far from each other
        left = 1.0 - np.abs(self._bars.rupture()) if self._bars.can_break else 1.0
        _add_drag(self._mesh.bars, self._x, self._v, self._factor * left, self.velocity(time), owned, out)

    def rate(self, speed: float) -> float:
        """Return the largest rate [1/s] of a bar's drag over its velocity and mass, at a speed [m/s]. Collective."""
        return max(self._mesh.comm.allgather(self._rate)) * speed

    def fastest(self) -> float:
        """Largest speed of the wind [m/s]."""
        rows = self._table.values if self.held is None or not self._holds else self.held[None]
        return float(np.linalg.norm(rows, axis=1).max())


class ExternalForce:
    """Nodal external forces at any time. Construction is collective.

    Attributes
    ----------
    ramped : whether gravity and loads without a table are multiplied by the time, which is a load factor then
    active : whether there are any forces (on any rank, at any time)
    gravity : (3,) constant gravity [m/s2], zero if it varies
    held : (owned, 3) forces of loads at the start of a stage [N], None for none; held constant where the stage gives no
        loads, else taken away, at once over time and in proportion with a load factor
    held_gravity : (3,) the same of gravity [m/s2]
    state_forces : that depend on the motion, which :meth:`follow` gives
    reactions : of supports that are being removed, by their names: forces (owned, 3) [N], begin and duration [s]
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], inertia: Inertia) -> None:
        self.inertia = inertia
        self._nodes = nodes
        self.state_forces: list[Wind | FunctionForce] = []
        self._state: ForceState | None = None
        self.wind = Wind(case, inertia.bars) if case.wind is not None else None
        if self.wind is not None and case.time is not None:
            self.state_forces.append(self.wind)
        self._drag: np.ndarray | None = None  # of the wind of a load case, on the truss as it is at its start
        self._keeps = case.holds("load"), case.holds("gravity")
        self._loads = None if self._keeps[0] else NodalLoads(case, nodes, inertia.mesh)
        varies = case.gravity is not None and case.gravity.varies
        gravity = case.gravity.acceleration if case.gravity is not None and not varies else (0.0, 0.0, 0.0)
        self.gravity = np.array(gravity, dtype=np.float64)
        self._gravity_table: Table | None = None
        if varies:
            self._gravity_table = Table(case.gravity.acceleration, case.gravity.interpolation == "smooth")
        self.ramped = case.static is not None
        self.active = bool(case.load) or bool(self.gravity.any()) or varies or bool(self.state_forces)
        self.held: np.ndarray | None = None
        self.held_gravity = np.zeros(3)
        self.reactions: dict[str, tuple[np.ndarray, float, float]] = {}
        changes = (self._loads is not None and not self._loads.steady) or (varies and not self._keeps[1])
        self._steady = not self.ramped and not changes
        self._constant: np.ndarray | None = None

    @property
    def steady(self) -> bool:
        """Whether the forces are constant from now on."""
        return self._steady and not self.state_forces and not self.reactions

    @property
    def scheduled(self) -> bool:
        """Whether the forces depend on time alone, by tables, and are known for many steps: see :meth:`schedule`."""
        if self.steady:
            return True
        kept = self._loads is None or self.held is not None
        return not (self.state_forces or self.reactions or self.ramped or kept)

    def schedule(self, steps: range, h: float) -> LoadSchedule:
        """Forces at the ends of some steps of a size [s]; none if they are constant."""
        if self.steady:
            return _CONSTANT
        times = [step * h for step in steps]
        gravity = np.array([self.gravity_at(time) for time in times])
        values = np.array([self._loads.values(time, 1.0).copy() for time in times])
        first, members, forces, columns = self._loads.arguments
        nodes = np.arange(len(self.inertia.mass)) if self.gravity_varies else members
        return LoadSchedule(gravity, nodes, values, first, members, forces, columns)

    def call(self, function: Callable[[float, ForceState], Any]) -> None:
        """Add the forces that a function returns."""
        self.state_forces.append(FunctionForce(function, self.inertia.mesh))
        self.active = True

    @property
    def functions(self) -> int:
        """Number of functions that return forces."""
        return sum(isinstance(force, FunctionForce) for force in self.state_forces)

    def follow(self, position: np.ndarray, v: np.ndarray) -> None:
        """Take positions [m] and velocities [m/s] (owned, 3), at which forces depend on the motion from here on."""
        mesh = self.inertia.mesh
        self._state = ForceState(position, v, mesh.node_ids[: mesh.n_owned], self._nodes)

    @property
    def failure(self) -> str | None:
        """Why a force could not be evaluated on this rank, None if all could."""
        return next((force.failure for force in self.state_forces if force.failure is not None), None)

    @property
    def gravity_varies(self) -> bool:
        """Whether gravity is a function of time."""
        return self._gravity_table is not None

    def at(self, time: float, out: np.ndarray) -> np.ndarray:
        """``out`` (owned, 3) [N] at a time [s], or at a load factor."""
        for component, gravity in enumerate(self.gravity_at(time)):  # much faster than a product with three columns
            np.multiply(self.inertia.mass, gravity, out=out[:, component])
        self._add_loads(time, out)
        for force in self.state_forces:
            force.add(time, self._state, out)
        if self._drag is not None:
            out += time * self._drag
        return out

    def take_drag(self, position: np.ndarray) -> None:
        """Take the drag of the wind at positions (owned, 3) [m] at rest as a load, which grows with the load factor.
        Collective."""
        mesh = self.inertia.mesh
        at_rest = ForceState(position, np.zeros_like(position), mesh.node_ids[: mesh.n_owned], self._nodes)
        self._drag = np.zeros_like(position)
        self.wind.add(0.0, at_rest, self._drag)
        self.active = True

    def constant(self) -> np.ndarray | None:
        """(owned, 3) [N], which must not be changed, if the forces are the same at all times, else None."""
        if not self.steady:
            return None
        if self._constant is None:
            self._constant = self.at(0.0, np.empty((len(self.inertia.mass), 3)))
        return self._constant

    def gravity_at(self, time: float) -> np.ndarray:
        """Acceleration (3,) [m/s2] at a time [s], or at a load factor."""
        if self._keeps[1]:
            return self.held_gravity
        if self._gravity_table is not None:
            own = self._gravity_table(time)
        else:
            own = (time if self.ramped else 1.0) * self.gravity
        return own if self.held is None else own + self._left(time) * self.held_gravity

    def loads_at(self, time: float) -> np.ndarray:
        """Forces of loads alone (owned, 3) [N] at a time [s], or at a load factor."""
        return self._add_loads(time, np.zeros((len(self.inertia.mass), 3)))

    def _add_loads(self, time: float, out: np.ndarray) -> np.ndarray:
        if self._loads is not None and self._loads.any:
            self._loads.add(time, time if self.ramped else 1.0, out)
        for force, begin, duration in self.reactions.values():
            if time < begin + duration:
                out += (1.0 - (time - begin) / duration) * force
        if self.held is not None:
            out += self.held if self._keeps[0] else self._left(time) * self.held
        return out

    def _left(self, time: float) -> float:
        """Share that is left of what a stage replaces."""
        return max(1.0 - time, 0.0) if self.ramped else 0.0

    def wind_at(self, time: float) -> np.ndarray:
        """Velocity of the wind (3,) [m/s] at a time [s]."""
        return np.zeros(3) if self.wind is None else self.wind.velocity(time)

    def hold(self, force: np.ndarray, gravity: np.ndarray, wind: np.ndarray, active: bool) -> None:
        """Take over what acts at the start of a stage: loads (owned, 3) [N], gravity [m/s2] and wind [m/s], (3,)."""
        self.held, self.held_gravity, self._constant = force, gravity, None
        if self.wind is not None:
            self.wind.held = wind
        self.active = self.active or active
