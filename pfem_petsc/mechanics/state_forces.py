"""External forces that depend on the motion: those of functions from Python, and drag of wind.

They are evaluated for each time of a balance's loads, before it is solved, at positions and velocities predicted for
that time from the state: exact positions with explicit schemes; x + t v + t^2 a/2 and v + t a a time t after the state
with others.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["ForceState", "FunctionForce", "StateForce"]


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


class StateForce(Protocol):
    """A force that depends on the motion.

    Attributes
    ----------
    failure : why the last force could not be evaluated on this rank, None if it could
    """

    failure: str | None

    def add(self, time: float, state: ForceState, out: np.ndarray) -> None:
        """Add the force at a time [s] to ``out`` (owned, 3) [N]. Collective."""


class FunctionForce:
    """The force that a function of time and state returns."""

    def __init__(self, function: Callable[[float, ForceState], Any], mesh: DistributedMesh) -> None:
        self.function, self.failure = function, None
        self._shape = mesh.n_owned, 3

    def add(self, time: float, state: ForceState, out: np.ndarray) -> None:
        """See :class:`StateForce`; what is wrong with a force becomes the failure, so that no rank is left alone."""
        try:
            force = np.asarray(self.function(time, state), dtype=np.float64)
        except Exception as error:  # noqa: BLE001 - of a user; the other ranks would wait
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.failure = f"raised {type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
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
