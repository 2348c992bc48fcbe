"""Divergence of the motion, detected by the energy and reported with the fastest node."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..energies import SUPPLIED
from ..errors import SimulationFailure

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["BlowUp"]

# energy created by the integration relative to the input; heavily damped explicit runs begin with up to 8
_CREATED = 20.0
# the same once nodes have been in contact: some schemes gain energy in each impact, which has a warning
_IN_CONTACT = 1e3
_ROWS = 6  # consecutive rows; after a start from rest, or when a wall first strikes, there is no input to compare with
_BARS = ("elastic_energy", "spring_energy")


class BlowUp:
    """Checks the history rows of a stage, which are the same on all ranks; collective if it reports.

    What the integration has created is the total energy, with all that is dissipated, less its lowest value so far, as
    far as the truss still holds it: in large steps, dissipation exceeds the work of the forces that dissipate. It is
    compared with what could move the truss: the kinetic energy at the start of the stage, the energy that its bars have
    released since, and the largest rise of each work. The energy of prestressed bars moves nothing while they hold it,
    and the works of earlier stages are spent. Rows of static stages are not compared: works over their increments are
    quadratures.
    """

    def __init__(self, model: Model, inertial: bool = True) -> None:
        self.model, self.inertial = model, inertial
        self._strange = 0
        self._most = model.rounding * model.length  # [J]: what is at rest has no other energy
        self._start: dict[str, float] = {}
        self._lowest: dict[str, float] = {}  # works
        self._lost = 0.0
        self._limit = _CREATED

    def kept(self) -> dict[str, Any]:
        """Return the state for a checkpoint: number of consecutive suspicious rows, energy input, the energies of the
        first row, lowest works, and the largest numerical dissipation [J]."""
        kept = {"strange": self._strange, "most": self._most, "lost": self._lost, "limit": self._limit}
        return kept | {"start": dict(self._start), "lowest": dict(self._lowest)}

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore the state from a checkpoint."""
        self._strange, self._most = int(kept["strange"]), float(kept["most"])
        self._start, self._lost = dict(kept["start"]), float(kept["lost"])
        self._lowest, self._limit = dict(kept["lowest"]), float(kept["limit"])

    def check(self, row: dict[str, Any], state: State) -> None:
        """Check a row.

        Raises
        ------
        SimulationFailure
            On all ranks, if the energy is not finite, or the energy created exceeds the input several times.
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
        if not self.inertial:
            return
        lost = float(row["numerical_dissipation"])
        if not self._start:
            self._start = {name: float(row[name]) for name in _BARS}
            # walls with mass as well: a truss at rest has no other energy than that of what hits it
            self._most += float(row["kinetic_energy"] + row["wall_kinetic_energy"])
            self._lost = lost
        released = sum(self._start[name] - float(row[name]) for name in _BARS)
        # rises only: what a force has taken away, as drag does, it need not give back
        for name in SUPPLIED:
            self._lowest[name] = min(self._lowest.get(name, np.inf), float(row[name]))
        rises = [float(row[name]) - self._lowest[name] for name in SUPPLIED]
        self._most = max(self._most, released, *rises)
        self._lost = max(self._lost, lost)
        held = float(row["kinetic_energy"] + row["wall_kinetic_energy"]) - released
        created = min(self._lost - lost, held)
        if row["active_contacts"] > 0:
            self._limit = _IN_CONTACT
        self._strange = self._strange + 1 if created > self._limit * self._most else 0
        if self._strange >= _ROWS:
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
