"""Rigid walls with mass, which move under the contact forces.

A wall of mass M is an additional node of the scheme without bars: M (alpha u + a_hat) = W - F(u), where W is its
weight, if gravity acts on it, and F the sum of its forces on the truss with the wall displaced by predictor + u. F is a
monotone function of u, piecewise linear for plane walls in explicit steps, so Newton's method converges after a few
active sets. The acceleration is then computed from F itself, so that truss and walls together conserve momentum to
rounding. Walls do not rotate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance, Scheme, State

if TYPE_CHECKING:
    from .walls.base import WallKeys

__all__ = ["FreeWalls", "NoFreeWalls"]

_ITERATIONS = 200
_FULL_MOVES = 20  # Newton's method converges after a few active sets, or else alternates between some of them

Answer = tuple[np.ndarray, np.ndarray | None]


class FreeWalls:
    """The walls of a case that have a mass; the same on all ranks.

    Attributes
    ----------
    at : (f,) indices of these walls among all walls of the case
    state : of the walls; x is the displacement from the initial position (f, 3)
    weight : (f, 3) [N], zero where gravity does not act
    """

    def __init__(
        self, walls: Sequence[WallKeys], scheme: Scheme, comm: MPI.Comm, gravity: tuple[float, float, float]
    ) -> None:
        self.at = np.array([k for k, wall in enumerate(walls) if wall.mass is not None], dtype=np.int64)
        self.mass = np.array([walls[k].mass for k in self.at])
        self.scheme, self.comm = scheme, comm
        speeds = np.array([walls[k].velocity or (0.0, 0.0, 0.0) for k in self.at])
        n = len(self.at)
        heavy = np.array([walls[k].gravity for k in self.at], dtype=bool)
        self.weight = np.where(heavy, self.mass, 0.0)[:, None] * np.array(gravity)
        self.state = State(np.zeros((n, 3)), speeds, *(np.zeros((n, 3)) for _ in range(5)))
        self._balance: Balance | None = None
        self._u = np.zeros((n, 3))

    def start(self, h: float) -> None:
        """Initialise the acceleration and the scheme's memory."""
        self.state.a = self.weight / self.mass[:, None]
        self.scheme.start(self.state, h)

    def begin(self, time: float, h: float) -> None:
        """Set the balance of a step from ``time``; schemes that solve for the next position move the walls first."""
        if self.scheme.solves_next_position and time > self.state.time:
            self.scheme.advance(self.state, h)
        self.state.time = time
        self._balance = self.scheme.balance(self.state, h)

    def finish(self, h: float, end: float) -> None:
        """Complete the walls' state with the solution; ``end`` is the time of the truss then, to the last bit."""
        self.scheme.finish(self.state, self._balance, self._u, h)
        if not self.scheme.solves_next_position:
            self.state.time = end

    @property
    def kinetic(self) -> float:
        """Kinetic energy of the walls [J]."""
        return 0.5 * float((self.mass[:, None] * self.state.v**2).sum())

    @property
    def balanced(self) -> np.ndarray:
        """Return the accelerations (f, 3) of the last balance [m/s2]."""
        known = 0.0 if self._balance.a_hat is None else self._balance.a_hat
        return self._balance.alpha * self._u + known

    def displacements(self, time: float) -> np.ndarray:
        """Return displacements (f, 3) [m] at the state's time, or at the end of the step being solved."""
        if self._balance is None or time == self.state.time:
            return self.state.x
        return self._balance.predictor + self._u

    def unpushed(self) -> np.ndarray:
        """Return displacements (f, 3) [m] at the end of the step being solved, without contact."""
        balance = self._balance
        known = 0.0 if balance.a_hat is None else balance.a_hat
        return balance.predictor + (self.weight / self.mass[:, None] - known) / balance.alpha

    def solve(self, forces: Callable[[], Answer], tolerance: float) -> bool:
        """Solve for the walls' increments; return whether the iteration converged, equal on all ranks. Collective.

        Parameters
        ----------
        forces : returns, for the current :meth:`displacements`, this rank's sums of the walls' forces on the truss
            (f, 3) [N] and of their derivatives dF/du (f, 3, 3) [N/m], or None where these are not known
        tolerance : of the walls' positions [m]
        """
        balance = self._balance
        n = 3 * len(self.at)
        weight = np.repeat(balance.alpha * self.mass, 3)
        rest = -self.weight if balance.a_hat is None else self.mass[:, None] * balance.a_hat - self.weight
        u = (-rest / (balance.alpha * self.mass[:, None])).ravel()
        matrix, earlier = np.diag(weight), None

        def evaluate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
            self._u = u.reshape(-1, 3)
            force, slope = forces()
            force = force.copy()
            self.comm.Allreduce(MPI.IN_PLACE, force)
            return force, slope, weight * u + rest.ravel() + force.ravel()

        force, slope, residual = evaluate(u)
        for iteration in range(_ITERATIONS):
            if slope is not None:
                slope = slope.copy()
                self.comm.Allreduce(MPI.IN_PLACE, slope)
                matrix = np.diag(weight)
                for k in range(len(self.at)):
                    matrix[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += slope[k]
            elif earlier is not None:
                # Broyden: the matrix nearest to the previous one that is consistent with the last move
                du, dr = u - earlier[0], residual - earlier[1]
                size = float(du @ du)
                if size > 0.0:
                    matrix = matrix + np.outer(dr - matrix @ du, du) / size
            earlier = u, residual
            move = np.linalg.solve(matrix, -residual) if n else np.zeros(0)
            if np.abs(move).max(initial=0.0) <= tolerance:
                break
            u = u + move
            force, slope, residual = evaluate(u)
            start = -float(move @ earlier[1])
            if iteration < _FULL_MOVES or start <= 0.0:
                continue
            # the active set changed within the move, where the slope no longer holds: bisect along the move
            least, most, part = 0.0, 1.0, 1.0
            size = np.abs(move).max()
            while abs(along := float(move @ residual)) > 0.5 * start and not (along < 0.0 and part == 1.0):
                least, most = (least, part) if along > 0.0 else (part, most)
                if (most - least) * size <= tolerance:
                    return False
                part = 0.5 * (least + most)
                u = earlier[0] + part * move
                force, slope, residual = evaluate(u)
        else:
            return False
        # the acceleration follows from the force and not from the position, so that momentum is conserved to rounding
        self._u = (-force - rest) / (balance.alpha * self.mass[:, None])
        return True

    def step_changed(self, scheme: Scheme) -> None:
        """Notify the scheme that the step size has changed."""
        scheme.step_changed(self.state)

    def kept(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        state = self.state
        memory = {name: array.tolist() for name, array in state.memory.items()}
        return {
            "x": state.x.tolist(),
            "v": state.v.tolist(),
            "a": state.a.tolist(),
            "time": state.time,
            "memory": memory,
            "increment": self._u.tolist(),
        }

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore the state from a checkpoint."""
        shape = self.state.x.shape
        for name in ("x", "v", "a"):
            setattr(self.state, name, np.array(kept[name], dtype=float).reshape(shape))
        self.state.time = kept["time"]
        self._u = np.array(kept["increment"], dtype=float).reshape(shape)
        for name, array in kept["memory"].items():
            self.state.memory[name] = np.array(array, dtype=float).reshape(shape)


class NoFreeWalls:
    """Null object for :class:`FreeWalls` if no wall has mass."""

    def __init__(self) -> None:
        self.at = np.empty(0, dtype=np.int64)
        self.mass = np.zeros(0)
        self.weight = self.balanced = np.zeros((0, 3))
        self.state = State(*(np.zeros((0, 3)) for _ in range(7)))
        self.kinetic = 0.0

    def start(self, h: float) -> None:
        """Do nothing."""

    def begin(self, time: float, h: float) -> None:
        """Do nothing."""

    def finish(self, h: float, end: float) -> None:
        """Nothing moves."""

    def step_changed(self, scheme: Scheme) -> None:
        """Do nothing."""

    def displacements(self, time: float) -> np.ndarray:
        """Return no displacements, (0, 3)."""
        return self.state.x

    def solve(self, forces: Callable[[], Answer], tolerance: float) -> bool:
        """Evaluate the forces once; return True."""
        forces()
        return True

    def kept(self) -> None:
        """Return None: a checkpoint needs nothing."""

    def load_state(self, kept: None) -> None:
        """Do nothing."""
