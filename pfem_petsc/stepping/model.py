"""The model of a case, distributed over ranks: mesh, bars, inertia, forces, supports, walls, links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..contact.constraint_set import ConstraintSet
from ..contact.contact import Contact, adjust_start
from ..contact.self_contact import SelfContact
from ..contact.wall_motion import Poses
from ..errors import InputError
from ..mechanics.bars import Bars, ProbedBars, check_areas, mesh_of_cases, section_of_bars
from ..mechanics.loads import ExternalForce
from ..mechanics.mass import Inertia, PointInertia, add_at_ends
from ..mechanics.rest_lengths import RestLengths, Temperatures, unstressed_lengths
from ..mechanics.springs import add_connectors, connected, make_springs, with_connectors
from ..mechanics.supports import Supports
from ..mesh.distribution import distribute, resolve_node_sets
from ..parallel.agreement import agreed

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh


@dataclass
class StageStart:
    """Where a stage starts from.

    Attributes
    ----------
    step : number of the last step before
    time : on the axis of the results
    position : (owned, 3) of the nodes [m]
    force : (owned, 3) of the loads [N]
    gravity : (3,) acceleration [m/s2]
    wind : (3,) velocity [m/s]
    walls : Poses of the walls of the stage before
    """

    step: int
    time: float
    position: np.ndarray
    force: np.ndarray
    gravity: np.ndarray
    wind: np.ndarray
    walls: Poses

    ARRAYS = ("position", "force")

    def arrays(self) -> dict[str, np.ndarray]:
        """Rows of owned nodes, for a checkpoint."""
        return {name: getattr(self, name) for name in self.ARRAYS}

    def scalars(self) -> dict[str, Any]:
        """The rest of it."""
        others = {name: value for name, value in vars(self).items() if name not in (*self.ARRAYS, "walls")}
        walls = {name: getattr(self.walls, name).tolist() for name in ("shifts", "turns")}
        return {name: np.asarray(value).tolist() for name, value in others.items()} | {"walls": walls}

    @classmethod
    def restored(cls, scalars: dict[str, Any], arrays: dict[str, np.ndarray]) -> StageStart:
        """What :meth:`scalars` and :meth:`arrays` gave."""
        vectors = {name: np.array(scalars[name]) for name in ("gravity", "wind")}
        shifts, turns = (np.array(scalars["walls"][name]) for name in ("shifts", "turns"))
        walls = Poses(shifts.reshape(-1, 3), turns.reshape(-1, 3, 3))
        return cls(int(scalars["step"]), float(scalars["time"]), **arrays, **vectors, walls=walls)


def refuse_inclined(
    source: str, mesh: DistributedMesh, nodes: np.ndarray, contact: Contact, links: ConstraintSet
) -> None:
    """Refuse walls, contact pairs and constraints at owned nodes (m,) with such supports. Collective.

    Raises
    ------
    InputError
        On all ranks.
    """
    numbers = mesh.node_ids[nodes]
    with agreed(mesh.comm):
        what = "a [[support]] prescribes a direction that is not an axis at node"
        for k, name in enumerate(contact.names):
            both = numbers[contact.members[nodes, contact.first[k]]]
            if len(both):
                raise InputError(
                    f"{source}: wall {name!r}: {what} {both.min()}, which the wall could also stop: contact "
                    "requires supports along axes; give the wall a node_set without such nodes"
                )
        both = np.intersect1d(numbers, links.rows.numbers)
        if len(both):
            raise InputError(
                f"{source}: contact_pair, constraint: {what} {both[0]}, which is part of one: these require "
                "supports along axes"
            )


class Model:
    """The model of a case on this rank. Construction is collective.

    Attributes
    ----------
    mesh, nodes, bars, probed_bars, inertia, external, supports, temperatures, rest_lengths, contact
    length : largest extent of the mesh [m]
    reach : largest coordinate magnitude [m], which sets the rounding of positions
    size : length that tolerances are relative to [m], see :mod:`~pfem_petsc.tolerances`
    nodal_stiffness : (owned,) sum of E A/l0 of a node's bars [N/m]
    node_rounding, rounding : residuals of nodes (owned,) due to rounding of positions [N], and their 2-norm
    warnings : about the mesh
    links : ConstraintSet, pairs and constraints that couple nodes to nodes
    self_contact : SelfContact of bars with bars, or None
    can_touch : whether nodes can touch walls or each other
    start : where a stage starts from, None for the start of a run
    first_step : number of the step at whose end the stage starts; 0 for the start of a run
    origin : where the stage starts on the axis of the results, on which its own time is counted from zero
    """

    def __init__(
        self, case: Case, comm: MPI.Comm, mesh: DistributedMesh | None = None, later: Sequence[Case] = ()
    ) -> None:
        self.case = case
        self.comm = comm
        self.start: StageStart | None = None
        self.first_step, self.origin = 0, 0.0
        self.warnings: list[str] = []
        self.mesh = mesh = self._load_mesh([case, *later]) if mesh is None else mesh
        self.nodes = resolve_node_sets(case, mesh)
        adjusted = adjust_start(case, self.nodes, mesh) if case.number == 0 else 0
        if adjusted:
            self.warnings.append(f"{adjusted} node{'s' * (adjusted > 1)} that started beyond walls moved onto them")
        with agreed(comm):
            self.bars = Bars(mesh, with_connectors(case))
        springs = make_springs(case, self.nodes, mesh)
        if springs is not None:
            self.bars.families.append(springs)
        self.probed_bars = ProbedBars(case, mesh)
        self.bars.mass_lengths = unstressed_lengths(case.editor[0].stages[0], self.bars)
        self.inertia = Inertia(mesh, self.bars, case.mass == "consistent", PointInertia(case, self.nodes, mesh))
        if case.time is not None:
            self.inertia.vary(case.time.damping_table)
        self.external = ExternalForce(case, self.nodes, self.inertia)
        with agreed(comm):
            self.supports = Supports(case, self.nodes, mesh)
            self.temperatures = Temperatures(case, mesh, self.bars)
            self.rest_lengths = RestLengths(case, self.bars)
        self.contact = Contact(case, self.nodes, mesh, self.supports.fixed)
        self.links = ConstraintSet(case, self.nodes, self.contact)
        self.self_contact = self.bars.touching = SelfContact(self) if case.self_contact is not None else None
        self.can_touch = self.contact.any or bool(self.links)
        if self.supports.inclined is not None:
            refuse_inclined(case.source, mesh, self.supports.inclined.nodes, self.contact, self.links)

        self.low, self.high = low, high = mesh.extremes()
        self.length = float((high - low).max())
        self.reach = float(max(np.abs(low).max(), np.abs(high).max()))
        self.size = self.contact.size
        stiffness = np.zeros(mesh.n_local)
        add_at_ends(mesh.bars, self.bars.stiffness, stiffness)
        self.nodal_stiffness = stiffness[: mesh.n_owned].copy()
        with np.errstate(over="ignore"):  # stiffness that overflows is refused by the plan
            self.node_rounding = 4.0 * np.finfo(float).eps * self.reach * self.nodal_stiffness
            squares = comm.allreduce(float((self.nodal_stiffness**2).sum()))
            self.rounding = 4.0 * np.finfo(float).eps * self.reach * np.sqrt(squares)
        self.total_mass = comm.allreduce(float(self.inertia.mass.sum()))
        speeds = [np.sqrt(m.upper_modulus() / m.density) for m in case.material.values()]
        self.wave_speed = max(speeds)

    def _load_mesh(self, cases: Sequence[Case]) -> DistributedMesh:
        case, comm = self.case, self.comm
        try:
            slab = mesh_of_cases(cases, comm)
        except InputError as error:
            # a generator knows its keys, but not the file that they are in
            if case.mesh.generator is None or str(error).startswith(f"{case.source}: "):
                raise
            raise InputError(f"{case.source}: {error}") from error
        self.warnings += slab.warnings
        with agreed(comm):
            sections = section_of_bars(case, slab)
            check_areas(case, slab, sections)
        mesh = distribute(slab, sections, comm, keep=connected(case))
        if connected(case):
            slab, sections = add_connectors(case, resolve_node_sets(case, mesh), mesh, slab, sections)
            bars = mesh.n_bars
            mesh.close()
            mesh = distribute(slab, sections, comm)
            mesh.n_connectors = mesh.n_bars - bars
        return mesh

    def begin_stage(self, start: StageStart) -> None:
        """Hold supports, loads and walls that remain in force as they are at the start of a stage. Collective."""
        self.start, self.first_step, self.origin = start, start.step, start.time
        self.supports.hold(start.position)
        active = self.comm.allreduce(bool(start.force.any()) or bool(start.gravity.any()), op=MPI.LOR)
        self.external.hold(start.force, start.gravity, start.wind, active)
        if self.case.starts_from is not None and self.case.wind is not None:
            self.external.take_drag(start.position)
        if self.case.holds("wall"):
            self.contact.motion.held = start.walls

    @property
    def touches(self) -> bool:
        """Whether nodes can touch walls or each other, or bars can touch bars."""
        return self.can_touch or self.self_contact is not None

    @property
    def bars_vary(self) -> bool:
        """Whether temperatures or rest lengths of bars change over time."""
        return self.temperatures.varying or self.rest_lengths.varying

    def change_bars(self, time: float) -> None:
        """Set the temperatures and rest lengths of bars at a time [s], or at a load factor."""
        if self.temperatures.varying:
            self.temperatures.apply(time)
        if self.rest_lengths.varying:
            self.rest_lengths.apply(time)

    @property
    def steady(self) -> bool:
        """Whether steps can be compiled ones: supports are along axes, bars and damping constant in time, loads
        depend on time alone, and walls are infinite, spheres, cylinders or surfaces of triangles, not tied, which
        bars do not touch between their nodes; beside pairs and constraints they are not triangles, do not turn, and
        have no mass."""
        others = any(family is not self.bars.springs for family in self.bars.families)
        between = self.self_contact is not None and self.self_contact.at_walls is not None
        changing = self.supports.inclined is not None or self.bars_vary or others or self.inertia.varies or between
        changing = changing or (bool(self.links) and self.contact.called.any())
        return not changing and self.external.scheduled and self.contact.steady

    def initial_velocity(self) -> np.ndarray:
        """Return initial velocities (owned, 3) [m/s]; later ``[initial]`` tables override earlier ones. Collective."""
        mesh, comm = self.mesh, self.comm
        v = np.zeros((mesh.n_owned, 3))
        # a stage adds to what its nodes have already
        points = mesh.points[: mesh.n_owned] if self.start is None else self.start.position
        for initial in self.case.initial:
            members = self.nodes[initial.node_set] if initial.node_set is not None else np.arange(mesh.n_owned)
            spin = np.array(initial.angular_velocity)
            v[members] = initial.velocity
            if spin.any():
                if initial.centre is not None:
                    centre = np.array(initial.centre)
                else:
                    mass = self.inertia.mass[members]
                    sums = comm.allreduce(np.append(mass @ points[members], mass.sum()))
                    centre = sums[:3] / sums[3]
                x, y, z = (points[members] - centre).T
                p, q, r = spin
                v[members] += np.stack([q * z - r * y, r * x - p * z, p * y - q * x], axis=1)
        return v
