"""One history row: sums over the ranks of energies, momenta, wall forces and probes, in one reduction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..contact.history import ContactColumns, contact_columns
from ..energies import BAR_ENERGIES, ENERGIES
from ..output.row import Row, RowLayout
from ..output.sums import HEAD, PAIR
from ..stepping.ledger import Ledger
from .probes import PROBED, Probes

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper

__all__ = ["Recorder"]

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
