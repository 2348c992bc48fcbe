"""Springs from nodes to the ground, and springs and dashpots between two nodes as bars without mass."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..case.tables import Section
from ..errors import InputError
from ..mesh.slab import MeshSlab, index_type, with_bars
from .materials.base import EXTRAPOLATED, Law, MaterialKeys, damped
from .supports import axes_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .elements import BlockPattern


class Springs:
    """Springs of the nodes that this rank owns, an :class:`~pfem_petsc.mechanics.elements.ElementFamily`.

    Attributes
    ----------
    nodes : (m,) local indices, distinct
    stiffness : (m, 3, 3), symmetric [N/m]
    anchors : (m, 3) positions without force [m]
    """

    energies = ("spring_energy",)

    def __init__(self, nodes: np.ndarray, stiffness: np.ndarray, anchors: np.ndarray) -> None:
        self.nodes, self.stiffness, self.anchors = nodes, stiffness, anchors

    def add_forces(self, x: np.ndarray, f: np.ndarray, commit: bool = False) -> tuple[float]:
        """Add the internal forces, and return the stored energy [J]."""
        stretch = x[self.nodes] - self.anchors
        force = self._times(stretch)
        f[self.nodes] += force
        return (0.5 * float((force * stretch).sum()),)

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Add the discrete gradient of a step from ``x0`` to ``x``, the force at mid-step: energies are quadratic."""
        f[self.nodes] += self._times(0.5 * (x0[self.nodes] + x[self.nodes]) - self.anchors)

    def add_product(self, weight: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add ``weight`` times the stiffness times ``u``."""
        out[self.nodes] += weight * self._times(u[self.nodes])

    def add_tangents(self, weight: float, pattern: BlockPattern, values: np.ndarray) -> None:
        """Add ``weight`` times the stiffness to the values of a matrix."""
        if not weight:
            return
        pattern.add_blocks(self.nodes, weight * self.stiffness, values)

    def largest(self) -> np.ndarray:
        """Return the largest stiffness of each node in any direction (m,) [N/m]."""
        return np.linalg.eigvalsh(self.stiffness)[:, -1]

    def _times(self, u: np.ndarray) -> np.ndarray:
        # written out: the order of the sum does not depend on the number of nodes
        k = self.stiffness
        return k[:, :, 0] * u[..., :1] + k[:, :, 1] * u[..., 1:2] + k[:, :, 2] * u[..., 2:]


class Ground:
    """Forces of springs and dashpots to the ground on some owned nodes.

    Parameters
    ----------
    springs : Springs, or None
    dashpots : (owned,) force over velocity of each node [N s/m]
    nodes : (m,)
    """

    def __init__(self, springs: Springs | None, dashpots: np.ndarray, nodes: np.ndarray) -> None:
        self._dashpots = dashpots[nodes][:, None]
        self._at, self._springs = np.empty(0, dtype=np.int64), springs
        if springs is not None:
            self._at = np.flatnonzero(np.isin(nodes, springs.nodes))
            of = np.searchsorted(springs.nodes, nodes[self._at])
            self._springs = Springs(self._at, springs.stiffness[of], springs.anchors[of])

    def add_forces(self, x: np.ndarray, v: np.ndarray, out: np.ndarray) -> None:
        """Add the forces [N] at positions and velocities to ``out``; (..., m, 3), any number of instants."""
        out -= self._dashpots * v
        if len(self._at):
            out[..., self._at, :] -= self._springs._times(x[..., self._at, :] - self._springs.anchors)


def make_springs(case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> Springs | None:
    """Return the springs of ``[[spring]]``, None if the case has none. A node in several gets the sum of stiffness."""
    grounded = [entry for entry in case.spring if entry.node_set is not None]
    if not grounded:
        return None
    stiffness = np.zeros((mesh.n_owned, 3, 3))
    for entry in grounded:
        tensor = np.diag(entry.stiffness)
        if entry.frame is not None:
            axes = axes_of(*np.array(entry.frame))
            tensor = axes.T @ tensor @ axes
            tensor = 0.5 * (tensor + tensor.T)
        stiffness[nodes[entry.node_set]] += tensor
    held = np.flatnonzero(stiffness.any(axis=(1, 2)))
    return Springs(held, stiffness[held], mesh.points[held].copy())


_AREA = "(springs and dashpots)"
"""Name of the field of the mesh with the areas of these bars; no dataset or array can have it by mistake."""


class _Viscous(MaterialKeys):
    """A material without stiffness and with the viscosity ``young_modulus`` [Pa s]."""

    def numbers(self) -> tuple[Any, ...]:
        return (0.0,), float(self.young_modulus), EXTRAPOLATED

    def choose(self, law: Law) -> Law:
        return damped(law)

    def largest_modulus(self) -> float:
        return 0.0


class _Table(NamedTuple):
    """A table ``[[spring]]`` or ``[[dashpot]]`` between nodes: its place in the case, node sets, and value."""

    key: str
    between: tuple[str, str]
    value: float
    viscous: bool


def connected(case: Case) -> list[_Table]:
    """Return the tables of springs, then dashpots, between nodes."""
    springs = [(f"spring[{k}]", entry, False) for k, entry in enumerate(case.spring)]
    dashpots = [(f"dashpot[{k}]", entry, True) for k, entry in enumerate(case.dashpot)]
    return [
        _Table(key, entry.between, float(entry.coefficient if viscous else entry.stiffness), viscous)
        for key, entry, viscous in springs + dashpots
        if entry.between is not None
    ]


def with_connectors(case: Case) -> Case:
    """Return the case with a section and a material for each such table; the case itself if it has none."""
    tables = connected(case)
    if not tables:
        return case
    scale = connector_modulus(case)
    made = type(case).__new__(type(case))  # not a copy, which is of the stage alone
    materials, sections = dict(case.material), dict(case.section)
    for table in tables:
        kind = _Viscous if table.viscous else MaterialKeys
        materials[table.key] = kind.model_construct(young_modulus=scale, density=0.0)
        sections[table.key] = Section.model_construct(area_field=_AREA, material=table.key)
    made.__dict__.update({**case.__dict__, "material": materials, "section": sections})
    return made


def connector_modulus(case: Case) -> float:
    """Modulus [Pa], and viscosity [Pa s], of all connectors: that of a bar of the case."""
    return max(material.young_modulus for material in case.material.values())


def add_connectors(
    case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh, slab: MeshSlab, sections: np.ndarray
) -> tuple[MeshSlab, np.ndarray]:
    """Return slab and sections of its bars with the springs and dashpots between nodes. Collective.

    Parameters
    ----------
    nodes : owned members of each node set; mesh : distributed without them

    Raises
    ------
    InputError
        On all ranks, for nodes without a distance or a partner.
    """
    ends, areas, kinds = [], [], []
    for k, table in enumerate(connected(case)):
        pairs, lengths = _pairs(f"{case.source}: {table.key}.between", table.between, nodes, mesh)
        ends.append(pairs)
        areas.append(table.value * lengths / connector_modulus(case))
        kinds.append(np.full(len(pairs), len(case.section) + k, dtype=np.int32))
    new = np.concatenate(ends).astype(index_type(slab.n_nodes))
    return with_bars(slab, mesh.comm, new, sections, np.concatenate(kinds), (_AREA, np.concatenate(areas)))


def _pairs(
    key: str, between: tuple[str, str], nodes: dict[str, np.ndarray], mesh: DistributedMesh
) -> tuple[np.ndarray, np.ndarray]:
    """Return mesh numbers (m, 2) and distances (m,) [m]: each node of the second set with the nearest of the first."""
    found = []
    for name in between:
        members = nodes[name]
        parts = mesh.comm.allgather((mesh.node_ids[members], mesh.points[members]))
        numbers, points = (np.concatenate(rows) for rows in zip(*parts, strict=True))
        order = np.argsort(numbers)
        found.append((numbers[order], points[order]))
    (first, places), (second, points) = found
    pairs, lengths = np.empty((len(second), 2), dtype=np.int64), np.empty(len(second))
    for k, (number, point) in enumerate(zip(second, points, strict=True)):
        away = np.where(first == number, np.inf, np.linalg.norm(places - point, axis=1))
        at = int(away.argmin())
        if away[at] == np.inf:
            raise InputError(
                f"{key}: node {number} is the only node of {between[0]!r}, and also in {between[1]!r}; name two nodes"
            )
        if not away[at] > 0.0:
            raise InputError(
                f"{key}: node {number} of {between[1]!r} and node {first[at]} of {between[0]!r} have the same position,"
                " so there is no line between them; use nodes at different positions"
            )
        pairs[k], lengths[k] = (first[at], number), away[at]
    return pairs, lengths
