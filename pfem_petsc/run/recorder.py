"""Rows of the history, with probes, over all stages of a case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..columns import (
    BAR_ENERGIES,
    CHANGES,
    COUNTS,
    ENERGIES,
    HEAD,
    IMBALANCE,
    ITERATIONS,
    LASTING,
    MOTION,
    OF_BARS,
    OF_BODIES,
    OF_PAIRS,
    OF_RUN,
    OF_WALLS,
    PAIR,
    PROBED,
    SUMMED,
    VECTORS,
    WALL,
    Layout,
    Row,
    Share,
    at_state,
    declared,
    fill_at_state,
)
from ..mechanics.springs import Ground
from ..stepping.impulses import ContactSums, record_forces
from ..stepping.stepper import Instants

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.stepper import Stepper


_NUMBERS = 3 * len(PROBED)


class Probes:
    """Nodes of all probes. Construction is collective.

    The share of a rank are its nodes, one after the other, with the vectors of :data:`PROBED`. A row has them by probe,
    by quantity, and by mesh number.

    Parameters
    ----------
    comm : MPI.Comm
    nodes : name of a probe to its nodes on this rank
    node_ids : (local nodes,) mesh numbers

    Attributes
    ----------
    ids : name to the mesh numbers of its nodes on all ranks, ascending
    nodes : (m,) int64, nodes of all probes on this rank
    size : numbers of this rank's share
    width : numbers of all probes in a row
    """

    def __init__(self, comm: MPI.Comm, nodes: Mapping[str, np.ndarray], node_ids: np.ndarray) -> None:
        self._comm = comm
        self.ids: dict[str, np.ndarray] = {}
        own = [node_ids[local] for local in nodes.values()]
        self.nodes = np.concatenate([np.empty(0), *nodes.values()]).astype(np.int64)
        parts = comm.allgather(own) if nodes else []
        self._counts = np.array([sum(len(ids) for ids in part) for part in parts], dtype=np.int64)
        # for each node in the order of the row, its place among those of all ranks in the order of ranks
        orders = []
        begins = np.concatenate([[0], np.cumsum(self._counts)]).astype(np.int64)[:-1]
        for k, name in enumerate(nodes):
            places = [at + sum(map(len, part[:k])) + np.arange(len(part[k])) for at, part in zip(begins, parts)]
            ids = np.concatenate([part[k] for part in parts])
            order = np.argsort(ids, kind="stable")
            self.ids[name] = ids[order]
            orders.append(np.concatenate(places)[order])
        self._orders = orders
        self.size = _NUMBERS * len(self.nodes)
        self.width = _NUMBERS * int(self._counts.sum())

    def fill(self, values: np.ndarray, state: State, acceleration: np.ndarray, support: np.ndarray) -> None:
        """Write this rank's share (m, number of PROBED, 3), with acceleration and forces of supports (owned, 3) to
        record, but not those of the ground, which :class:`Recorder` adds to rows of all steppers."""
        nodes = self.nodes
        values[:, 0], values[:, 1], values[:, 2] = state.x[nodes], state.v[nodes], acceleration[nodes]
        values[:, 3] = support[nodes] + state.contact[nodes]

    def unite(self, share: np.ndarray, out: np.ndarray) -> None:
        """Write the numbers of all probes (width,), as a row has them, from the shares (size,). Collective."""
        if not self._orders:
            return
        values = share
        if self._comm.size > 1:
            values = np.empty(self.width)
            self._comm.Allgatherv(np.ascontiguousarray(share), [values, _NUMBERS * self._counts])
        values, at = values.reshape(-1, len(PROBED), 3), 0
        for order in self._orders:
            end = at + _NUMBERS * len(order)
            out[at:end].reshape(len(PROBED), -1, 3)[:] = values[order].swapaxes(0, 1)
            at = end


class Handover(NamedTuple):
    """What a stage changes in the state that it is handed, the same on all ranks.

    Attributes
    ----------
    work, momentum : of the velocities that it adds [J], (3,) [N s]
    bars : (number of BAR_ENERGIES,) what the rows of the stage before had of its own, and those of this stage have
        besides, to the energies of bars in their rest volumes [J]: dissipated energies stay where rest lengths change
    """

    work: float
    momentum: np.ndarray
    bars: np.ndarray


_ADDED = [one for one in ENERGIES if one.source != "derived"]
_SIDES = {one.name: one.side for one in ENERGIES} | {part: one.side for one in ENERGIES for part in one.parts}
_SIGNS = np.array([{"supplied": -1.0, "part": 0.0}.get(_SIDES[one.name], 1.0) for one in _ADDED])
_BARS, _ENERGIES = HEAD.indices(BAR_ENERGIES), HEAD.indices(one.name for one in _ADDED)


class Recorder:
    """Builds history rows; :meth:`row` is collective and returns the row on all ranks.

    Parameters
    ----------
    stepper : Stepper
    columns : of all stages of the case, see :attr:`columns`; what this one does not have, such as a wall that is gone,
        is zero in its rows; sums, contact times and the load factor keep their values. None for a case without stages

    Attributes
    ----------
    columns : name to the type of a value, with its shape
    energy_scale : largest energy of any kind in the rows so far [J]
    layout : of a row
    carried : (width of a row of this stage,) sums of the stages before, added to its columns; None without
    rest : (width of a row of all stages,) values of the columns that this stage does not have; None without stages
    probed : nodes of all probes on this rank
    probe_nodes, probe_bars : name of a probe to the mesh numbers of its nodes or bars, ascending, as in its columns
    """

    def __init__(self, stepper: Stepper, columns: Mapping[str, np.dtype] | None = None) -> None:
        self.stepper, self.model = stepper, stepper.model
        self._at_state = at_state(self.model)
        self.start_energy: float | None = None
        self.energy_scale = 0.0
        self.carried: np.ndarray | None = None
        model = self.model
        probes = {probe.name: model.nodes[probe.node_set] for probe in model.case.output.probe}
        self._probes = Probes(model.comm, probes, model.mesh.node_ids)
        self.probe_nodes, self.probed = self._probes.ids, self._probes.nodes
        self.probe_bars = model.probed_bars.ids
        # static analyses have no velocities
        self._ground = Ground(model.bars.springs, model.inertia.points.damping, self.probed)
        self._layout = Layout(self._columns())
        self.columns = self._layout.columns if columns is None else columns
        self.layout, self.rest = self._layout, None
        if columns is not None:
            self.layout = Layout(columns)
            self._at = self.layout.indices(self._layout.places)
            self.rest = np.zeros(self.layout.width)
            self.rest[self.layout["stage"]] = model.case.number
        self._place()

    def _columns(self) -> dict[str, np.dtype]:
        """Return the columns of this stage in the order of a row."""
        model, contact = self.model, self.model.contact
        of_analysis = [declared(name) for name in self.stepper.columns]
        wanted = (*OF_RUN, *of_analysis, *ITERATIONS, *COUNTS, *ENERGIES, IMBALANCE, *VECTORS, CHANGES)
        found = {column.name: column.dtype for column in wanted if column.exists(model)}
        for name, moves in zip(contact.names, contact.moving, strict=True):
            found |= {f"wall/{name}/{one.name}": one.dtype for one in (*OF_WALLS, *(MOTION if moves else ()))}
        for name in self._bodies:
            found |= {f"wall/{name}/{one.name}": one.dtype for one in OF_BODIES}
        for table in model.links.columns:
            found |= {f"{table}/{one.name}": one.dtype for one in OF_PAIRS}
        for name, ids in self.probe_bars.items():
            found |= {f"bar/{name}/{one.name}": np.dtype((float, (len(ids),))) for one in OF_BARS}
        for name, ids in self.probe_nodes.items():
            found |= {f"probe/{name}/{one.name}": np.dtype((float, (len(ids), 3))) for one in PROBED}
        return found

    @property
    def _bodies(self) -> list[str]:
        """The walls with inertia."""
        contact = self.model.contact
        bodies = contact.motion.bodies
        return [contact.names[k] for k in bodies.at[bodies.turners]]

    def _place(self) -> None:
        """Find where the sums of a share are in a row."""
        contact, tables, layout = self.model.contact, self.model.links.columns, self._layout
        walls = [f"wall/{name}/" for name in contact.names]
        names = [*HEAD.places, *([CHANGES.name] if contact.any else [])]
        names += [wall + one for wall in walls for one in WALL.places]
        names += [f"{table}/{one}" for table in tables for one in PAIR.places]
        of_bars = {name: dtype for name, dtype in layout.columns.items() if name.startswith("bar/")}
        sums = Layout({name: declared(name).dtype for name in names} | of_bars)
        names += of_bars
        recorded = [name for name in names if name in layout.places]
        self._from, self._to = sums.indices(recorded), layout.indices(recorded)
        self._probed = sums.width  # where probes begin
        self._contact_times = layout.indices(wall + "contact_time" for wall in walls)
        moving = [wall + one.name for wall, moves in zip(walls, contact.moving, strict=True) if moves for one in MOTION]
        self._motion = layout.indices(moving)
        self._turning = layout.indices(f"wall/{name}/{one.name}" for name in self._bodies for one in OF_BODIES)
        self._energies = layout.indices(one.name for one in _ADDED)
        self._bars = layout.indices(BAR_ENERGIES)
        self._parts = [
            (layout.first(one.name), [layout.first(part) for part in one.parts]) for one in ENERGIES if one.parts
        ]

    def row(self, alarm: bool = False) -> Row:
        """Return the history row of the present state. Collective; see :meth:`rows`."""
        self.stepper.instants = None
        vectors, _ = self.rows(alarm)
        return Row(self.layout, vectors[0])

    def rows(self, alarm: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (m, width) of the batch of steps that has been made, or that of the present state, and which
        of them some rank has not made or has a fault in, (m,) bool. Collective.

        ``alarm``: whether this rank has a fault in the present state.
        """
        stepper, contact = self.stepper, self.model.contact
        instants, stepper.instants = stepper.instants or self._present(alarm), None
        position, velocity, _, reaction = np.moveaxis(
            instants.shares[:, self._probed :].reshape(len(instants.shares), -1, len(PROBED), 3), 2, 0
        )
        self._ground.add_forces(position, velocity, reaction)
        total = self._total(instants.shares)
        alarms = total[:, HEAD.first("alarm")] > 0.0
        contacts = None
        if contact.any:
            walls = total[-1, HEAD.width + 1 :][: WALL.width * len(contact.names)]
            contacts = walls[WALL.first("contacts") :: WALL.width]
        times = contact.log.meet(self.model.comm, contacts)[instants.noted]
        with np.errstate(invalid="ignore", over="ignore"):  # sums that are not finite are told by the checks of rows
            vectors = self._unpack(total, (instants.place, instants.number, stepper.smallest), times)
        for vector, time in zip(vectors, instants.time.tolist() if len(self._motion) else [], strict=False):
            motion = np.hstack([contact.positions(time), contact.velocities(time)])
            vector[self._motion] = motion[contact.moving].ravel()
            if len(self._turning):
                vector[self._turning] = contact.motion.bodies.rotation.ravel()
        if self.rest is not None:
            own, vectors = vectors, np.repeat(self.rest[None], len(vectors), axis=0)
            vectors[:, self._at] = own
        return vectors, alarms

    def _total(self, shares: np.ndarray) -> np.ndarray:
        """Return the sums over all ranks from this rank's shares (m, width), and the probes of all. Collective."""
        probes = self._probed
        total = np.empty((len(shares), probes + self._probes.width))
        sums = np.ascontiguousarray(shares[:, :probes])
        if self.model.comm.size > 1:
            for row in sums:  # the order of the sum over ranks depends on the length of a message
                self.model.comm.Allreduce(MPI.IN_PLACE, row)
        total[:, :probes] = sums
        for share, out in zip(shares, total, strict=True):
            self._probes.unite(share[probes:], out[probes:])
        return total

    def _present(self, alarm: bool) -> Instants:
        """Return what a row needs of the present state."""
        stepper, state, contact = self.stepper, self.stepper.state, self.model.contact
        impulses, walls = stepper.ledger.impulses, stepper.solution.walls
        model = self.model
        bars = model.probed_bars.width
        share = Share(len(contact.names), len(model.links.columns), bars, len(self._probes.nodes))
        head = share.head
        head[:] = stepper.ledger.sums
        head[_BARS] += stepper.energy.energies
        head[HEAD.first("alarm")] = alarm
        changes, contact.log.changes = contact.log.changes, 0
        sums = ContactSums(
            # those of no contact are read-only
            *(getattr(walls, name).copy() for name in ("force", "moment", "contacts")),
            contact.log.releases,
            self.model.links.totals(),
        )
        record_forces(impulses.state.v, sums, changes, share.numbers)
        fill_at_state(self._at_state, stepper, head)
        model.probed_bars.fill(model.bars, state.x, share.bars)
        held = self.model.supports.any or self.model.bars.springs is not None
        reacts = held and not stepper.scheme.balance_at_endpoints
        if self.probe_nodes or reacts:
            acceleration, support = stepper.recorded()
            self._probes.fill(share.probes, state, acceleration, support)
            if reacts:
                head[HEAD["support_force"]] = stepper.support_force(support)
        of_state = stepper.number, stepper.place, state.time
        number, place, time, noted = (np.array([of]) for of in (*of_state, contact.log.noted))
        return Instants(number, place, time, share.numbers[None], noted)

    def _unpack(self, sums: np.ndarray, of_run: tuple[Any, ...], contact_times: np.ndarray) -> np.ndarray:
        """Return the values of m rows of this stage from the sums over ranks; begin those of the next row.

        ``of_run``: values of the columns :data:`~pfem_petsc.columns.OF_RUN`; ``contact_times`` (m, walls) [s].
        """
        stepper, layout = self.stepper, self._layout
        vectors, at = np.empty((len(sums), layout.width)), layout.first
        vectors[:, self._to] = sums[:, self._from]
        vectors[:, layout.width - self._probes.width :] = sums[:, self._probed :]
        for column, value in zip(OF_RUN, of_run, strict=True):
            vectors[:, at(column.name)] = value
        for name in stepper.columns:
            vectors[:, at(name)] = getattr(stepper, name)
        vectors[:, at("newton_iterations")], vectors[:, at("linear_iterations")] = stepper.iterations
        for first, parts in self._parts:
            vectors[:, first] = np.cumsum(vectors[:, parts], axis=1)[:, -1]
        vectors[:, layout["centre_of_mass"]] /= self.model.total_mass
        energies = sums[:, _ENERGIES]
        if self.carried is not None:
            energies = energies + self.carried[self._energies]
        # the order of a sum over an axis depends on the number of rows, that of sums so far does not
        held = np.cumsum(_SIGNS * energies, axis=1)[:, -1]
        if self.start_energy is None:
            self.start_energy = float(held[0])
        self.energy_scale = max(self.energy_scale, float(np.abs(energies).max()))
        vectors[:, at("energy_imbalance")] = held - self.start_energy
        stepper.iterations = [0, 0]
        vectors[:, self._contact_times] = contact_times
        return vectors if self.carried is None else vectors + self.carried

    def begin_stage(self, before: Recorder, last: Row, handed: Handover) -> Row:
        """Go on after the stage that has ended; return the row of the start. Collective.

        Energies stay balanced, and momentum that of its impulses. Work and momentum of velocities that the stage adds
        count as external; kinetic energy that is lost, when a static stage or a support stops nodes, as numerical
        dissipation, what supports that begin to move give as external work, momentum that either changes as impulse of
        supports. What other temperatures change at once is thermal work, also together with another prestress, which
        does prestress work.

        Parameters
        ----------
        before : of the stage that has ended
        last : row of its end
        handed : with what the stage changes
        """
        first, layout, case = self.row(), self._layout, self.model.case
        summed = [name for name in layout.places if declared(name).stages == SUMMED]
        change: dict[str, Any] = {name: np.array(last[name], dtype=float) for name in summed}
        work, momentum, bars = handed
        if before.carried is not None:
            bars = bars + before.carried[before._bars]
        gained = first["kinetic_energy"] - last["kinetic_energy"] - work
        change["external_work"] += work + max(gained, 0.0) + first["wall_kinetic_energy"] - last["wall_kinetic_energy"]
        change["numerical_dissipation"] += max(-gained, 0.0)
        if "temperature" in case.given or case.stressed:
            # dissipation too: bars may be damaged or break by it at once
            work_of = "thermal_work" if "temperature" in case.given else "prestress_work"
            change[work_of] += sum(first[name] - last[name] for name in BAR_ENERGIES) + bars.sum()
        change["external_impulse"] += momentum
        change["support_impulse"] += first["momentum"] - last["momentum"] - momentum
        self.carried = np.zeros(layout.width)
        for name, value in change.items():
            self.carried[layout[name]] = np.ravel(value)
        self.carried[self._bars] = bars
        for derived, parts in self._parts:
            self.carried[derived] = self.carried[parts].sum()
        for name in self.layout.places:
            if declared(name).stages in (SUMMED, LASTING):
                self.rest[self.layout[name]] = np.ravel(last[name])
        self.start_energy, self.energy_scale = before.start_energy, before.energy_scale
        return self.row()
