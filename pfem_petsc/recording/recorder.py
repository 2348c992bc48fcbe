"""What is recorded: rows of the history with probes, over all stages of a case, and the fields of snapshots."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..contact.monitoring import ContactColumns, contact_columns
from ..energies import BAR_ENERGIES, ENERGIES
from ..fields import FIELDS, Field, cell_fields
from ..output.history import Row, RowLayout
from ..output.sums import HEAD, PAIR
from ..stepping.ledger import Ledger

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model
    from ..stepping.stepper import Stepper


PROBED = ("position", "velocity", "acceleration", "reaction")
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

    def places(self) -> np.ndarray:
        """Return where this rank's nodes begin in its share (m,) int64."""
        return _NUMBERS * np.arange(len(self.nodes), dtype=np.int64)

    def fill(self, share: np.ndarray, state: State, acceleration: np.ndarray, support: np.ndarray) -> None:
        """Write this rank's share (size,), with acceleration and forces of supports (owned, 3) to record."""
        values, nodes = share.reshape(-1, len(PROBED), 3), self.nodes
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


_BARS = [HEAD.first(name) for name in BAR_ENERGIES]
_DERIVED = [energy for energy in ENERGIES if energy.source == "derived"]
_STATE = [energy for energy in ENERGIES if energy.value is not None]
_SUMMED = [energy for energy in ENERGIES if energy.source != "derived"]
_ENERGIES = [HEAD.first(energy.name) for energy in _SUMMED]
_SIDES = {energy.name: energy.side for energy in ENERGIES} | {p: e.side for e in ENERGIES for p in e.parts}
_SIGNS = np.array([{"supplied": -1.0, "part": 0.0}.get(_SIDES[energy.name], 1.0) for energy in _SUMMED])


class Recorder:
    """Builds history rows; :meth:`row` is collective and returns the row on all ranks.

    Attributes
    ----------
    columns : name to shape of a value
    types : name to dtype if it is not float64
    energy_scale : largest energy of any kind in the rows so far [J]
    iterations : Newton and linear-solver iterations since the last row
    alarmed : whether any rank raised a fault flag with the last row
    carried : (width of a row,) sums of the stages before, added to its columns; None without
    probe_nodes : probe name to the mesh numbers of its nodes, ascending, the order of rows in a probe's columns
    """

    def __init__(self, stepper: Stepper, ledger: Ledger) -> None:
        self.stepper = stepper
        self.ledger = ledger
        self.model = stepper.model
        self.start_energy: float | None = None
        self.energy_scale = 0.0
        self.alarmed = False
        self.iterations = [0, 0]
        case, mesh, comm = self.model.case, self.model.mesh, self.model.comm
        self.columns: dict[str, tuple[int, ...]] = {"time": (), "step": (), "step_size": ()}
        self.columns |= dict.fromkeys(stepper.columns, ())
        counts = ("active_contacts", "broken_bars", *(("slack_bars",) if self.model.bars.slackens else ()))
        self.columns |= dict.fromkeys(("newton_iterations", "linear_iterations", *counts), ())
        self.columns |= {energy.name: () for energy in ENERGIES} | {"energy_imbalance": ()}
        self.columns |= {name: (3,) for name, size in HEAD.sizes.items() if size == 3}
        self.types: dict[str, Any] = dict.fromkeys(
            ("step", "newton_iterations", "linear_iterations", *counts), np.int64
        )
        self.columns |= {name: shape for name, shape, _ in contact_columns(self.model.contact)}
        self.types |= {name: kind for name, _, kind in contact_columns(self.model.contact) if kind is not float}
        for name in self.model.links.columns:
            self.columns |= {f"{name}/{what}": (3,) for what in PAIR.sizes}
        probes = {probe.name: self.model.nodes[probe.node_set] for probe in case.output.probe}
        self._probes = Probes(comm, probes, mesh.node_ids)
        self.probe_nodes = self._probes.ids
        for name, ids in self.probe_nodes.items():
            self.columns |= {f"probe/{name}/{quantity}": (len(ids), 3) for quantity in PROBED}
        self.layout = RowLayout(self.columns, self.types)
        self.carried: np.ndarray | None = None
        self._contact = ContactColumns(self.model.contact)
        links = PAIR.width * len(self.model.links.columns)
        # where the sums of walls, links and probes begin
        self._starts = np.cumsum([HEAD.width, self._contact.size, links, self._probes.size])
        self._sums = np.zeros(self._starts[-1])
        # indices of the numbers of the head in a row, and where walls, links and probes begin there
        recorded = [name for name in HEAD.sizes if name in self.columns]
        self._from = np.array([k for name in recorded for k in range(HEAD.width)[HEAD[name]]])
        places = [self.layout.places[name][:2] for name in recorded]
        self._to = np.concatenate([np.arange(*place) for place in places])
        self._at = {name: place[0] for name, place in self.layout.places.items()}
        head = sum(int(np.prod(shape)) for name, shape in self.columns.items() if "/" not in name)
        self._begin = head - ("active_set_changes" in self.columns)

    @property
    def width(self) -> int:
        """Number of sums in this rank's share of a row; those of probes are of its own nodes alone."""
        return len(self._sums)

    def probed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return this rank's nodes of all probes; where their positions are among its sums of probes; and the distance
        between the vectors of a node there, over three. Arrays (m,) int64."""
        return self._probes.nodes, self._probes.places(), np.ones(len(self._probes.nodes), dtype=np.int64)

    def count(self, newton: int, linear: int) -> None:
        """Add the iterations of a step to those of the next row."""
        self.iterations[0] += newton
        self.iterations[1] += linear

    def row(self, alarm: bool = False) -> Row:
        """Return the history row of the present state. Collective.

        ``alarm``: whether this rank has a fault; :attr:`alarmed` is then true on all ranks.
        """
        self._fill(self._sums, alarm)
        return self.row_of(self.total(self._sums))

    def total(self, sums: np.ndarray) -> np.ndarray:
        """Return the sums over all ranks from this rank's share (width,), and the probes of all. Collective."""
        probes = self._starts[2]
        total = np.empty(probes + self._probes.width)
        total[:probes] = sums[:probes]
        if self.model.comm.size > 1:
            self.model.comm.Allreduce(MPI.IN_PLACE, total[:probes])
        self._probes.unite(sums[probes:], total[probes:])
        return total

    def row_of(self, total: np.ndarray) -> Row:
        """Return the row at the state's step and time from what :meth:`total` gives. Collective."""
        self.alarmed = total[HEAD.first("alarm")] > 0.0
        self.model.contact.log.meet(self.model.comm, self._contact.contacts(total[HEAD.width :]))
        return Row(self.layout, self._unpack(total))

    def _fill(self, sums: np.ndarray, alarm: bool) -> None:
        """Write this rank's share of a row."""
        stepper, state, ledger = self.stepper, self.stepper.state, self.ledger
        energy, solution = stepper.energy, stepper.solution
        ledger.complete()
        sums[: HEAD.width] = ledger.sums
        sums[_BARS] = energy.energies
        for term in _STATE:
            sums[HEAD.first(term.name)] = term.value(stepper)
        sums[HEAD.first("active_contacts")], sums[HEAD.first("alarm")] = solution.contacts, alarm
        sums[HEAD.first("broken_bars")] = stepper.ruptures.count
        if self.model.bars.slackens:
            sums[HEAD.first("slack_bars")] = self.model.bars.slack_count()
        walls, links, at, _ = self._starts
        if self._contact.size:
            self._contact.fill(sums[walls:links], solution.walls, ledger.impulses)
        ledger.impulses.fill_links(sums[links:at].reshape(-1, PAIR.width))
        held = self.model.supports.any or self.model.bars.springs is not None
        reacts = held and not stepper.scheme.balance_at_endpoints
        if self.probe_nodes or reacts:
            acceleration, support = stepper.recorded()
            self._probes.fill(sums[at:], state, acceleration, support)
            if reacts:
                sums[HEAD["support_force"]] = stepper.support_force(support)

    def _unpack(self, sums: np.ndarray) -> np.ndarray:
        """Return the values of a row from the sums over ranks."""
        stepper, state = self.stepper, self.stepper.state
        vector, at = np.empty(self.layout.width), self._at
        vector[self._to] = sums[self._from]
        vector[at["time"]], vector[at["step"]], vector[at["step_size"]] = (
            stepper.place,
            stepper.number,
            stepper.smallest,
        )
        for name in stepper.columns:
            vector[at[name]] = getattr(stepper, name)
        vector[at["newton_iterations"]], vector[at["linear_iterations"]] = self.iterations
        for term in _DERIVED:
            vector[at[term.name]] = sum(sums[HEAD.first(name)] for name in term.parts)
        total = at["centre_of_mass"]
        vector[total : total + 3] /= self.model.total_mass
        energies = sums[_ENERGIES]
        if self.carried is not None:
            energies = energies + self.carried[self._to[_ENERGIES]]
        held = float(_SIGNS @ energies)
        if self.start_energy is None:
            self.start_energy = held
        self.energy_scale = max(self.energy_scale, float(np.abs(energies).max()))
        vector[at["energy_imbalance"]] = held - self.start_energy
        self.iterations = [0, 0]
        walls, links, probes, _ = self._starts
        begin = self._begin
        if self._contact.size:
            self._contact.put(sums[walls:links], state.time, vector[begin : begin + self._contact.width])
            begin += self._contact.width
        width = PAIR.width * len(self.model.links.columns)
        vector[begin : begin + width] = sums[links:probes]
        begin += width
        vector[begin:] = sums[probes:]
        return vector if self.carried is None else vector + self.carried


_WORKS = {energy.name for energy in ENERGIES if energy.source == "ledger"}
_LASTING = ("contact_time", "load_factor")


def accumulates(name: str) -> bool:
    """Whether a column is a sum over the steps that each stage begins at zero."""
    last = name.rsplit("/", 1)[-1]
    return name in _WORKS or last.endswith("impulse") or last == "releases"


class StageColumns:
    """The columns of a case with stages: those of all stages, and ``stage``, the number of the stage from 0.

    Attributes
    ----------
    columns, types : as :class:`~pfem_petsc.recording.recorder.Recorder` has them
    """

    def __init__(self) -> None:
        self.columns: dict[str, tuple[int, ...]] = {"time": (), "step": (), "stage": ()}
        self.types: dict[str, Any] = {"stage": np.int64}

    def add(self, recorder: Recorder) -> None:
        """Add the columns of a stage."""
        self.columns |= recorder.columns
        self.types |= recorder.types

    @cached_property
    def layout(self) -> RowLayout:
        """Of the rows, once the columns of all stages are there."""
        return RowLayout(self.columns, self.types)


class StageRows:
    """Puts the rows of one stage into the columns of all.

    What a stage does not have, such as a wall that is gone, is zero; sums, contact times and the load factor keep their
    values.

    Parameters
    ----------
    columns : StageColumns
    number : of the stage
    layout : of the stage's own rows

    Attributes
    ----------
    rest : (width,) values of the columns that the stage does not have
    """

    def __init__(self, columns: StageColumns, number: int, layout: RowLayout) -> None:
        self.layout = columns.layout
        places = self.layout.places
        self._at = np.concatenate([np.arange(*places[name][:2]) for name in layout.places])
        self.rest = np.zeros(self.layout.width)
        self.rest[places["stage"][0]] = number

    def begin(self, last: Mapping[str, Any]) -> None:
        """Keep what lasts of the last row of the stage before."""
        for name, (first, end, _, _) in self.layout.places.items():
            if accumulates(name) or name.rsplit("/", 1)[-1] in _LASTING:
                self.rest[first:end] = np.ravel(last[name])

    def fill(self, row: Row) -> Row:
        """The row in the columns of all stages."""
        vector = self.rest.copy()
        vector[self._at] = row.vector
        return Row(self.layout, vector)


def carried_sums(recorder: Recorder, last: Mapping[str, Any], kick: tuple[float, np.ndarray]) -> np.ndarray:
    """What a stage adds to its own sums (width of its row,): those of the stages before, and what changed between.

    Energies stay balanced, and momentum that of its impulses. Work and momentum of velocities that the stage adds count
    as external; kinetic energy that is lost, when a static stage or a support stops nodes, as numerical dissipation,
    what supports that begin to move give as external work, momentum that either changes as impulse of supports. What
    other temperatures change at once is thermal work, also together with another prestress, which does prestress work.
    Collective.

    Parameters
    ----------
    recorder : of the stage at its start
    last : row of the end of the stage before, in the columns of all stages
    kick : work [J] and momentum (3,) [N s] of the added velocities
    """
    first, layout = recorder.row(), recorder.layout
    change: dict[str, Any] = {name: np.array(last[name], dtype=float) for name in layout.places if accumulates(name)}
    work, momentum = kick
    gained = first["kinetic_energy"] - last["kinetic_energy"] - work
    change["external_work"] += work + max(gained, 0.0) + first["wall_kinetic_energy"] - last["wall_kinetic_energy"]
    change["numerical_dissipation"] += max(-gained, 0.0)
    case = recorder.model.case
    if "temperature" in case.given or case.stressed:
        # dissipation too: bars may be damaged or break by it at once
        of_bars = [name for name in BAR_ENERGIES if name in layout.places]
        work_of = "thermal_work" if "temperature" in case.given else "prestress_work"
        change[work_of] += sum(first[name] - last[name] for name in of_bars)
    change["external_impulse"] += momentum
    change["support_impulse"] += first["momentum"] - last["momentum"] - momentum
    carried = np.zeros(layout.width)
    for name, value in change.items():
        at, end, _, _ = layout.places[name]
        carried[at:end] = np.ravel(value)
    return carried


class Snapshot:
    """The data from which fields are computed.

    Attributes
    ----------
    model : Model
    state : State
    start : (owned, 3) positions in the mesh [m]
    acceleration : returns the acceleration to record (owned, 3) [m/s2]; collective with consistent mass
    """

    def __init__(self, model: Model, state: State, acceleration: Callable[[], np.ndarray] | None = None) -> None:
        self.model, self.state, self.acceleration = model, state, acceleration
        self.start = model.mesh.points[: model.mesh.n_owned]

    @cached_property
    def bars(self) -> dict[str, np.ndarray]:
        """Name to (local bars,): strain, stress, axial force, internal variables."""
        return self.model.bars.fields(self.state.x)

    def temperature(self) -> np.ndarray:
        """(local bars,) temperature above reference [K], zero if the case has none."""
        temperatures = self.model.temperatures
        return temperatures.values if temperatures.any else 0.0 * self.bars["strain"]


class Fields:
    """Fields of the nodes and bars of this rank.

    Attributes
    ----------
    points, cells : names of the fields that the case selects; by default all that it has, except internal variables of
        material laws other than the plastic strain

    Parameters
    ----------
    model : Model
    names : of fields in place of those that the case selects; a case with stages has the same in all of them
    """

    def __init__(self, model: Model, names: Collection[str] | None = None) -> None:
        self.model = model
        wanted = model.case.output.fields if names is None else names
        taken = [field for field in FIELDS if (field.default(model) if wanted is None else field.name in wanted)]
        self._points = [field for field in taken if field.place == "nodes"]
        self._cells = [field for field in taken if field.place == "bars"]
        for name, unit in model.bars.internal.items():
            if wanted is not None and name in wanted and name not in cell_fields():
                self._cells.append(Field(name, "bars", unit, lambda now, name=name: now.bars[name]))
        self.points = [field.name for field in self._points]
        self.cells = [field.name for field in self._cells]

    def at_nodes(self, state: State, acceleration: Callable[[], np.ndarray]) -> dict[str, np.ndarray]:
        """Return name to (owned, 3). Collective if ``acceleration`` is."""
        now = Snapshot(self.model, state, acceleration)
        return {field.name: field.value(now) for field in self._points}

    def at_bars(self, state: State) -> dict[str, np.ndarray]:
        """Return name to (local bars,)."""
        now = Snapshot(self.model, state)
        return {field.name: field.value(now) for field in self._cells}
