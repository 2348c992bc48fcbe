"""One history row: sums over the ranks of energies, momenta, wall forces and probes, in one reduction."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from ..contact.history import ContactColumns, contact_columns
from ..output.row import Row, RowLayout
from .ledger import Ledger

__all__ = ["Recorder"]

_HEAD = 29  # numbers of a row before those of walls, pairs and probes
_SUMS = 23  # numbers of the sums before those
_PROBED = ("position", "velocity", "acceleration", "reaction")


class Recorder:
    """Builds history rows; :meth:`row` is collective and gives the row to every rank.

    Attributes
    ----------
    columns : name to shape of a row's value
    types : name to dtype where it is not float64
    energy_scale : the largest that any energy was in the rows so far [J]
    iterations : Newton and linear-solver iterations since the last row
    alarmed : whether any rank raised an alarm with the last row
    probe_nodes : probe name to the mesh numbers of its nodes, ascending: the order of rows in a probe's columns
    """

    def __init__(self, stepper, ledger: Ledger) -> None:
        self.stepper = stepper
        self.ledger = ledger
        self.model = stepper.model
        self.start_energy: float | None = None
        self.energy_scale = 0.0
        self.alarmed = False
        self.iterations = [0, 0]
        case, mesh, comm = self.model.case, self.model.mesh, self.model.comm
        self.columns: dict[str, tuple[int, ...]] = {"time": (), "step": (), "step_size": ()}
        self.columns |= {name: () for name in ("newton_iterations", "linear_iterations", "active_contacts")}
        self.columns |= {name: () for name in ("kinetic_energy", "elastic_energy", "plastic_dissipation")}
        self.columns |= {name: () for name in ("plastic_heat", "hardening_energy", "damping_dissipation")}
        self.columns |= {name: () for name in ("external_work", "contact_work", "thermal_work")}
        self.columns |= {name: () for name in ("numerical_dissipation", "energy_imbalance")}
        self.columns |= {name: (3,) for name in ("momentum", "angular_momentum", "centre_of_mass", "support_force")}
        self.types: dict[str, Any] = dict.fromkeys(
            ("step", "newton_iterations", "linear_iterations", "active_contacts"), np.int64
        )
        self.columns |= {name: shape for name, shape, _ in contact_columns(self.model.contact)}
        self.types |= {name: kind for name, _, kind in contact_columns(self.model.contact) if kind is not float}
        self._pairs = self.model.pairs
        if self._pairs is not None:
            self.columns |= {f"pair/{name}/force": (3,) for name in self._pairs.names}
        self.probe_nodes: dict[str, np.ndarray] = {}
        self._probes: list[tuple[str, np.ndarray, np.ndarray]] = []
        for probe in case.output.probe:
            local = self.model.nodes[probe.node_set]
            ids = mesh.node_ids[local]
            everyone = np.sort(np.concatenate(comm.allgather(ids)))
            self.probe_nodes[probe.name] = everyone
            self._probes.append((probe.name, local, np.searchsorted(everyone, ids)))
            for quantity in _PROBED:
                self.columns[f"probe/{probe.name}/{quantity}"] = (len(everyone), 3)
        self.layout = RowLayout(self.columns, self.types)
        self._contact = ContactColumns(self.model.contact)
        self._sums = np.zeros(_SUMS + self._contact.size + sum(12 * len(n) for n in self.probe_nodes.values()))

    @property
    def width(self) -> int:
        """Numbers that a row sums up."""
        return len(self._sums)

    def probed(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes of all probes in the order of their columns, where one rank has all of them, and where each starts."""
        nodes = [local[np.argsort(place)] for _, local, place in self._probes]
        starts = np.cumsum([0, *(len(part) for part in nodes)])
        return np.concatenate(nodes or [np.empty(0)]).astype(np.int64), starts.astype(np.int64)

    def count(self, newton: int, linear: int) -> None:
        """Add the iterations of a step to those of the next row."""
        self.iterations[0] += newton
        self.iterations[1] += linear

    def row(self, alarm: bool = False) -> Row:
        """The history row of the present state. Collective.

        ``alarm``: this rank has something that all must speak about; :attr:`alarmed` is then true on all.
        """
        model, sums = self.model, self._sums
        self._fill(sums, alarm)
        if model.comm.size > 1:
            model.comm.Allreduce(MPI.IN_PLACE, sums)
        return self.row_of(sums)

    def row_of(self, sums: np.ndarray) -> Row:
        """The row of the state's step and time from its sums (width,) over all ranks. Collective."""
        model = self.model
        self.alarmed = sums[22] > 0.0
        model.contact.log.meet(model.comm, self._contact.contacts(sums[_SUMS:]))
        return Row(self.layout, self._unpack(sums))

    def _fill(self, sums: np.ndarray, alarm: bool) -> None:
        """This rank's share of a row."""
        stepper, state, ledger = self.stepper, self.stepper.state, self.ledger
        energy, solution = stepper.energy, stepper.solution
        sums[:4] = ledger.kinetic, energy.elastic, energy.plastic_heat, energy.hardening
        sums[4:21] = ledger.sums
        sums[21:23] = solution.contacts, alarm
        at = _SUMS + self._contact.size
        if self._contact.size:
            self._contact.fill(sums[_SUMS:at], solution.walls)
        for name, local, place in self._probes:
            size = 12 * len(self.probe_nodes[name])
            nodes = sums[at : at + size].reshape(4, -1, 3)
            nodes[:] = 0.0
            reaction = state.support[local] + state.contact[local]
            nodes[:, place] = state.x[local], state.v[local], state.a[local], reaction
            at += size

    def _unpack(self, sums: np.ndarray) -> np.ndarray:
        """The vector of a row from the sums over the ranks."""
        stepper, state = self.stepper, self.stepper.state
        energies = sums[:9].tolist()
        kinetic, elastic, heat, hardening, external, contact, damping, numerical, thermal = energies
        held = kinetic + elastic + heat + hardening + damping + numerical - external - contact - thermal
        if self.start_energy is None:
            self.start_energy = held
        self.energy_scale = max(self.energy_scale, *map(abs, energies))
        vector = np.empty(self.layout.width)
        vector[:17] = (
            state.time,
            state.step,
            stepper.smallest,
            *self.iterations,
            sums[21],
            kinetic,
            elastic,
            heat + hardening,
            heat,
            hardening,
            damping,
            external,
            contact,
            thermal,
            numerical,
            held - self.start_energy,
        )
        vector[17:_HEAD] = sums[9:21]
        vector[23:26] /= self.model.total_mass
        self.iterations = [0, 0]
        source, at = _SUMS + self._contact.size, _HEAD + self._contact.width
        if self._contact.size:
            self._contact.put(sums[_SUMS:source], state.time, vector[_HEAD:at])
        if self._pairs is not None:
            for force in self._pairs.totals().values():
                vector[at : at + 3] = force
                at += 3
        vector[at:] = sums[source:]
        return vector
