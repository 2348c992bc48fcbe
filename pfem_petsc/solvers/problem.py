"""The balance of one step as a function of the position increment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from ..contact.transform import Transform
    from ..integrators.base import Balance, State
    from ..stepping.model import Model


# ---- loops over the nodes of implicit steps; NumPy takes several times as long for rows of three


@kernel
def add_up(nodal, u, known, weight, f, g):
    """Write nodal u + known + weight f to ``g``; vectors (owned, 3)."""
    for i in range(len(g)):
        for c in range(3):
            g[i, c] = nodal[i] * u[i, c] + known[i, c] + weight * f[i, c]


@kernel
def largest_distance(one, other):
    """Return the largest distance of nodes between positions (n, 3); NaN if any is not a number."""
    largest = 0.0
    for i in range(len(one)):
        x, y, z = one[i, 0] - other[i, 0], one[i, 1] - other[i, 1], one[i, 2] - other[i, 2]
        square = x * x + y * y + z * z
        if not square <= largest:
            largest = square
            if square != square:
                break
    return np.sqrt(largest)


@kernel
def extend(before, after, differences, orders):
    """Replace first and second backward differences (n, 6) of vectors by those at ``after`` (n, 3), and the orders (n,)
    by those that would have predicted it best."""
    for i in range(len(after)):
        first = second = third = 0.0
        for c in range(3):
            one = after[i, c] - before[i, c]
            two = one - differences[i, c]
            three = two - differences[i, 3 + c]
            differences[i, c] = one
            differences[i, 3 + c] = two
            first += one * one
            second += two * two
            third += three * three
        order = 1 if second < first else 0
        if third < min(first, second):
            order = 2
        orders[i] = order


@kernel
def extrapolate(vectors, differences, orders, factor, out):
    """Write vectors (n, 3) expected next, by polynomials of the ``orders`` (n,), times a factor."""
    for i in range(len(out)):
        for c in range(3):
            value = vectors[i, c]
            if orders[i] > 0:
                value += differences[i, c]
            if orders[i] > 1:
                value += differences[i, 3 + c]
            out[i, c] = factor * value


class StepProblem:
    """Residual g(w) of one step, where w is the increment u from the predictor in transformed coordinates, u = T w.

    Friction is part of g (see :mod:`pfem_petsc.contact.frames`) and makes its derivative unsymmetric. Prescribed
    components have a zero residual and a unit row; the guess contains their values.

    Attributes
    ----------
    x : (local, 3) positions [m]
    u : (owned, 3) increment of the last evaluation [m]
    nodal : (owned,) diagonal of inertia and damping [N/m]
    scale : entry on the diagonal at prescribed components [N/m]
    target : (k,) prescribed components of u where some are along no axis: these are mixed into unknowns that linear
        solvers change, and components of w along them are ignored
    """

    def __init__(
        self,
        model: Model,
        state: State,
        balance: Balance,
        external: np.ndarray,
        transform: Transform,
    ) -> None:
        self.transform = transform
        self.model = model
        self.state = state
        self.balance = balance
        self.external = external
        mesh, inertia = model.mesh, model.inertia
        self.x = np.zeros((mesh.n_local, 3))
        self.f = np.zeros((mesh.n_local, 3))
        self.u = np.zeros((mesh.n_owned, 3))
        self._work = np.zeros((mesh.n_owned, 3))
        self._evaluated = np.full_like(self.x, np.nan)  # positions of the forces f
        self.nodal = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self.scale = float((self.nodal if balance.alpha else model.nodal_stiffness).max(initial=0.0))
        # the part independent of u: M a_hat + C v_hat + (1 - w) f_n - f_ext
        known = -external
        if balance.a_hat is not None:
            known = known + inertia.mass_times(balance.a_hat, np.zeros_like(known))
        if inertia.damped and balance.v_hat is not None:
            known = known + inertia.damping_times(balance.v_hat, np.zeros_like(known))
        if balance.weight < 1.0:
            known = known + (1.0 - balance.weight) * state.f[: mesh.n_owned]
        self.known = known
        supports = model.supports
        self.target = None if supports.inclined is None else supports.lacking(balance.predictor, balance.time)

    def increment(self, w: np.ndarray) -> np.ndarray:
        """Return u (owned, 3) for w. Collective."""
        self.u[:] = w
        self.transform.forward(self.u)
        if self.target is not None:
            self.model.supports.put(self.u, self.target)
        return self.u

    def coordinates(self, u: np.ndarray) -> np.ndarray:
        """Return w (owned, 3) for u. Collective."""
        w = u.copy()
        self.transform.inverse(w)
        return w

    def imbalance(self, u: np.ndarray, g: np.ndarray, evaluated: bool = False) -> None:
        """Write g = M a + C v + f_int - f_ext at u, in x, without supports and walls [N]. Collective.

        If bars were ``evaluated`` since temperatures, rest lengths or their history have changed, forces are not
        evaluated again at the same positions.
        """
        inertia, balance, weight = self.model.inertia, self.balance, self.balance.weight
        internal = self.state.f[: len(u)]
        if weight:
            self.place(u)
            if not (evaluated and np.array_equal(self.x, self._evaluated)):
                self._evaluate()
            internal = self.f[: len(u)]
        if not inertia.consistent:
            add_up(self.nodal, u, self.known, weight, internal, g)
            if inertia.redistribution is not None:
                inertia.redistribution.add_times(balance.alpha, u, g)
            return
        g[:] = inertia.mass_times(balance.alpha * u, self._work)
        if inertia.damped and balance.eta:
            g += inertia.damping_times(balance.eta * u, self._work)
        g += self.known
        if weight:
            g += weight * internal

    def _evaluate(self) -> None:
        """Evaluate the internal forces at the positions."""
        if self.balance.discrete_gradient:
            self.model.bars.step_forces(self.state.x, self.x, self.f)
        else:
            self.model.bars.forces(self.x, self.f, commit=False)
        self._evaluated[:] = self.x

    def free_part(self, w: np.ndarray, end: np.ndarray) -> float:
        """Return the part of the way from w to ``end``, both (owned, 3), on which no bar passes another. Collective."""
        touch = self.model.self_contact
        if touch is None:
            return 1.0
        self.place(self.increment(w))
        start = self.x.copy()
        self.place(self.increment(end))
        return touch.free_part(start, self.x)

    def residual(self, w: np.ndarray, g: np.ndarray) -> None:
        """Write g(w) (owned, 3) [N]. Collective."""
        self.imbalance(self.increment(w), g)
        self.transform.residual(self.balance.predictor, self.u, g)
        self.model.supports.clear(g)

    def place(self, u: np.ndarray) -> None:
        """Set the positions of all local nodes to the predictor plus u. Collective."""
        np.add(self.balance.predictor, u, out=self.x[: self.model.mesh.n_owned])
        self.model.mesh.update_ghosts(self.x)
