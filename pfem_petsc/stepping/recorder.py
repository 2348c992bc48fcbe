"""One history row: sums over the ranks of energies, momenta, wall forces and probes, in one reduction."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from ..contact.history import contact_columns, contact_sums, contact_values
from .ledger import Ledger

__all__ = ["Recorder"]

_PROBED = ("position", "velocity", "acceleration", "reaction")


class Recorder:
    """Builds history rows; :meth:`row` is collective and gives the row to every rank.

    Attributes
    ----------
    columns : name to shape of a row's value
    types : name to dtype where it is not float64
    energy_scale : the largest that any energy was in the rows so far [J]
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
        self.iterations = np.zeros(2, dtype=np.int64)
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

    def count(self, newton: int, linear: int) -> None:
        """Add the iterations of a step to those of the next row."""
        self.iterations += (newton, linear)

    def row(self, alarm: bool = False) -> dict[str, Any]:
        """The history row of the present state. Collective.

        ``alarm``: this rank has something that all must speak about; :attr:`alarmed` is then true on all.
        """
        stepper, state, model = self.stepper, self.stepper.state, self.model
        x = state.position
        walls = stepper.solution.walls
        energy = stepper.energy
        parts = [
            [self.ledger.kinetic, energy.elastic, energy.plastic_heat, energy.hardening],
            self.ledger.work,
            self.ledger.totals,
            [float(stepper.solution.contacts)],
            [float(alarm)],
            contact_sums(model.contact, walls),
        ]
        for name, local, place in self._probes:
            nodes = np.zeros((4, len(self.probe_nodes[name]), 3))
            reaction = state.support[local] + state.contact[local]
            for k, values in enumerate((x[local], state.v[local], state.a[local], reaction)):
                nodes[k, place] = values
            parts.append(nodes.ravel())
        sums = np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])
        model.comm.Allreduce(MPI.IN_PLACE, sums)
        self.alarmed = sums[22] > 0.0
        model.contact.log.meet(model.comm)
        return self._unpack(sums)

    def _unpack(self, sums: np.ndarray) -> dict[str, Any]:
        stepper, state = self.stepper, self.stepper.state
        kinetic, elastic, heat, hardening, external, contact, damping, numerical, thermal = sums[:9]
        held = kinetic + elastic + heat + hardening + damping + numerical - external - contact - thermal
        if self.start_energy is None:
            self.start_energy = float(held)
        self.energy_scale = max(self.energy_scale, float(np.abs(sums[:9]).max()))
        row: dict[str, Any] = {
            "time": state.time,
            "step": state.step,
            "step_size": stepper.smallest,
            "newton_iterations": int(self.iterations[0]),
            "linear_iterations": int(self.iterations[1]),
            "active_contacts": round(sums[21]),
            "kinetic_energy": kinetic,
            "elastic_energy": elastic,
            "plastic_dissipation": heat + hardening,
            "plastic_heat": heat,
            "hardening_energy": hardening,
            "damping_dissipation": damping,
            "external_work": external,
            "contact_work": contact,
            "thermal_work": thermal,
            "numerical_dissipation": numerical,
            "energy_imbalance": held - self.start_energy,
            "momentum": sums[9:12],
            "angular_momentum": sums[12:15],
            "centre_of_mass": sums[15:18] / self.model.total_mass,
            "support_force": sums[18:21],
        }
        self.iterations[:] = 0
        values, at = contact_values(self.model.contact, sums, 23, state.time)
        row |= values
        if self._pairs is not None:
            row |= {f"pair/{name}/force": force for name, force in self._pairs.totals().items()}
        for name, nodes in self.probe_nodes.items():
            size = 12 * len(nodes)
            values = sums[at : at + size].reshape(4, len(nodes), 3)
            at += size
            for k, quantity in enumerate(_PROBED):
                row[f"probe/{name}/{quantity}"] = values[k]
        return row
