"""What solvers ask of a model, and of the balance of a step that they linearise."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance
from ..mechanics.bars import Bars
from ..mechanics.mass import Inertia
from ..mechanics.supports import Supports
from ..mesh.distribution import DistributedMesh


class Mechanics(Protocol):
    """The truss without contact: the mesh, and what acts at its bars and nodes.

    Attributes
    ----------
    bars_vary : whether temperatures or rest lengths of bars change over time
    """

    comm: MPI.Comm
    mesh: DistributedMesh
    bars: Bars
    inertia: Inertia
    supports: Supports

    @property
    def bars_vary(self) -> bool: ...


class Coordinates(Protocol):
    """Coordinates w of a solve, u = T w, in which each row of contact is a bound on one unknown.

    Implemented by :class:`~pfem_petsc.contact.transform.Transform`, which describes the methods.

    Attributes
    ----------
    identity : whether w equals u and the residual is unchanged
    bounded : whether the solve has bounds
    nodewise : whether w differs from u by ``frames`` of nodes only, and the Hessian is symmetric
    links : coordinates of links that may close in the step
    """

    identity: bool
    bounded: bool
    links: Iterable[Any]

    @property
    def nodewise(self) -> bool: ...

    @property
    def frames(self) -> Any: ...

    @property
    def sliding(self) -> Any: ...

    def turns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None: ...

    def forward(self, w: np.ndarray) -> None: ...

    def left(self) -> np.ndarray: ...

    def linear(self, left: np.ndarray, u: np.ndarray, out: np.ndarray) -> None: ...

    def diagonal(self, left: np.ndarray, blocks: Callable[[np.ndarray], np.ndarray], diagonal: np.ndarray) -> None: ...


class Linearisable(Protocol):
    """The balance of a step as a function of w.

    Implemented by :class:`~pfem_petsc.stepping.problem.StepProblem`, which describes the methods.

    Attributes
    ----------
    balance : coefficients of the integrator
    transform : coordinates of w
    x : (local, 3) positions [m]
    u : (owned, 3) increment of the last evaluation [m]
    nodal : (owned,) diagonal of inertia and damping [N/m]
    scale : entry on the diagonal at prescribed components [N/m]
    """

    balance: Balance
    transform: Coordinates
    x: np.ndarray
    u: np.ndarray
    nodal: np.ndarray
    scale: float

    def increment(self, w: np.ndarray) -> np.ndarray: ...

    def place(self, u: np.ndarray) -> None: ...

    def hessian(self, w: np.ndarray, matrix: Any, values: np.ndarray) -> None: ...

    def hessian_here(self, matrix: Any, values: np.ndarray, stored: np.ndarray | None = None) -> None: ...
