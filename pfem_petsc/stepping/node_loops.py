"""Compiled loops over owned nodes for explicit steps, each one pass over the nodal arrays."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["accelerations", "explicit_increments", "hold", "hold_still", "react"]


@kernel
def explicit_increments(external, f, mass, damping, alpha, eta, a_hat, v_hat, stiffness, u):
    """Solve (alpha m + eta c) u = f_ext - f_int - m a_hat - c v_hat for every node.

    ``external``, ``a_hat``, ``v_hat`` are (owned, 3), or (0, 3) for zero; ``stiffness`` (owned,) and ``u`` (owned, 3)
    are written.
    """
    loaded = len(external) > 0
    carried = len(a_hat) > 0
    damped = len(v_hat) > 0
    for i in range(len(u)):
        stiffness[i] = alpha * mass[i] + (eta * damping[i] if damped else 0.0)
    if not (loaded or carried or damped):  # apart, because only loops without conditions are vectorised
        for i in range(len(u)):
            inverse = 1.0 / stiffness[i]
            u[i, 0] = -f[i, 0] * inverse
            u[i, 1] = -f[i, 1] * inverse
            u[i, 2] = -f[i, 2] * inverse
        return
    if not (carried or damped):
        for i in range(len(u)):
            inverse = 1.0 / stiffness[i]
            u[i, 0] = (external[i, 0] - f[i, 0]) * inverse
            u[i, 1] = (external[i, 1] - f[i, 1]) * inverse
            u[i, 2] = (external[i, 2] - f[i, 2]) * inverse
        return
    for i in range(len(u)):
        inverse = 1.0 / stiffness[i]
        for c in range(3):
            load = -f[i, c]
            if loaded:
                load += external[i, c]
            if carried:
                load -= mass[i] * a_hat[i, c]
            if damped:
                load -= damping[i] * v_hat[i, c]
            u[i, c] = load * inverse


@kernel
def accelerations(u, alpha, a):
    """Compute ``a`` = alpha u; arrays (3 n,)."""
    for j in range(len(u)):
        a[j] = alpha * u[j]


@kernel
def hold(begin, end, origin, nodes, components, positions, predictor, stiffness, u, load):
    """Set the prescribed components [begin, end) of ``u`` to their values; ``load`` (k,) output: force that would move
    them [N]. ``origin``: the node in the first row of ``predictor``, ``stiffness`` and ``u``."""
    for k in range(begin, end):
        i, c = nodes[k] - origin, components[k]
        load[k] = stiffness[i] * u[i, c]
        u[i, c] = positions[k] - predictor[i, c]


@kernel
def hold_still(begin, end, origin, nodes, components, positions, x, half, h, stiffness, u, load, held):
    """Like :func:`hold` for a scheme that predicts ``x`` + ``h half``, arrays (n, 3) of all nodes; the increments are
    written to ``held`` (k,) too."""
    for k in range(begin, end):
        node, c = nodes[k], components[k]
        i = node - origin
        load[k] = stiffness[i] * u[i, c]
        held[k] = positions[k] - (x[node, c] + h * half[node, c])
        u[i, c] = held[k]


@kernel
def react(begin, end, origin, nodes, components, load, contact, stiffness, u, support):
    """Write support forces [begin, end) into ``support`` (owned, 3) [N], from the loads that :func:`hold` computed."""
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        support[i, c] = stiffness[i - origin] * u[i - origin, c] - load[k] - contact[i, c]
