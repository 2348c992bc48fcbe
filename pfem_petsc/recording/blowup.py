"""Divergence of the motion, detected by the energy and reported with the fastest node."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..energies import STORED, SUPPLIED
from ..errors import SimulationFailure

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["BlowUp"]

_CREATED = 1e3  # energy created by the integration relative to the input, far beyond any error of a valid run
_ROWS = 10  # consecutive rows; after a start from rest, or when a wall first strikes, there is no input to compare with
_ROUNDING = 1e-12  # strains below are rounding; their energy is the minimum energy input


class BlowUp:
    """Checks the history rows of a run, which are the same on all ranks; collective if it reports."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._rows = 0
        self._strange = 0
        self._most = model.total_mass * (_ROUNDING * model.wave_speed) ** 2  # [J]

    def kept(self) -> dict[str, Any]:
        """Return the state for a checkpoint: number of rows, of consecutive suspicious rows, and energy input [J]."""
        return {"rows": self._rows, "strange": self._strange, "most": self._most}

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore the state from a checkpoint."""
        self._rows, self._strange, self._most = int(kept["rows"]), int(kept["strange"]), float(kept["most"])

    def check(self, row: dict[str, Any], state: State) -> None:
        """Check a row.

        Raises
        ------
        SimulationFailure
            On all ranks, if the energy is not finite, or a thousand times the energy input.
        """
        held = row["kinetic_energy"] + row["elastic_energy"]
        when = f"step {row['step']}, t = {row['time']:.6g} s"
        if not np.isfinite(held) and row["step"] == 0:
            raise SimulationFailure(
                f"{when}: the energy is not finite at the start{self._where(state)}: correct loads, velocities and "
                "material (SI units)"
            )
        if not np.isfinite(held):
            raise SimulationFailure(
                f"{when}: the energy is not finite: the motion diverged{self._where(state)}; reduce time.step"
            )
        # walls with mass as well: a truss at rest has no other energy than that of what hits it
        start = sum(row[name] for name in STORED) + row["plastic_dissipation"] if self._rows == 0 else 0.0
        self._most = max(self._most, abs(start), *(abs(row[name]) for name in SUPPLIED))
        self._rows += 1
        created = -row["numerical_dissipation"]
        self._strange = self._strange + 1 if created > _CREATED * self._most else 0
        if self._strange > _ROWS:
            raise SimulationFailure(
                f"{when}: the integration has created {created:.3g} J, but only {self._most:.3g} J were supplied: "
                f"the motion is unstable and fastest at {self._fastest(state)}; reduce time.step"
            )

    def _where(self, state: State) -> str:
        """Return the first node and bar, by mesh number, with positions or velocities that are not finite."""
        mesh = self.model.mesh
        bad = ~(np.isfinite(state.position).all(axis=1) & np.isfinite(state.v).all(axis=1))
        node = min(mesh.node_ids[: mesh.n_owned][bad], default=mesh.n_nodes)
        lost = ~np.isfinite(state.x).all(axis=1)
        bar = min(mesh.bar_ids[lost[mesh.bars].any(axis=1)], default=mesh.n_bars)
        comm = self.model.comm
        node, bar = min(comm.allgather(int(node))), min(comm.allgather(int(bar)))
        text = f", first seen at node {node}" if node < mesh.n_nodes else ""
        return text + (f" and bar {bar}" if bar < mesh.n_bars else "")

    def _fastest(self, state: State) -> str:
        """Return the fastest node and one of its bars."""
        mesh = self.model.mesh
        speed = np.linalg.norm(state.v, axis=1)
        mine = (-1.0, -1, -1)
        if len(speed):
            at = int(np.argmax(speed))
            bar = int(mesh.bar_ids[(mesh.bars == at).any(axis=1)].min())
            mine = (float(speed[at]), int(mesh.node_ids[at]), bar)
        fastest, node, bar = max(self.model.comm.allgather(mine))
        return f"node {node} (bar {bar}), {fastest:.3g} m/s"
