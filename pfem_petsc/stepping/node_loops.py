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
def hold_still(
    begin, end, origin, nodes, components, positions, mass, external, f, x, half, h, alpha, inverse, held, support
):
    """:func:`hold` and :func:`react` for a leapfrog scheme without damping and contact, before its other components.

    Writes the increments of the prescribed components [begin, end) to ``held`` (k,) and their reactions to ``support``
    (owned, 3) [N], and sets their inverse stiffness to zero in ``inverse`` (3 m,). This array and the forces ``f`` (m,
    3) are those of the nodes from ``origin`` on.
    """
    loaded = len(external) > 0
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        stiffness = alpha * mass[i]
        pull = f[i - origin, c]
        force = external[i, c] - pull if loaded else -pull
        free = stiffness * (force * (1.0 / stiffness))
        held[k] = positions[k] - (x[i, c] + h * half[i, c])
        support[i, c] = stiffness * held[k] - free
        inverse[3 * (i - origin) + c] = 0.0


@kernel
def react(begin, end, origin, nodes, components, load, contact, stiffness, u, support):
    """Write support forces [begin, end) into ``support`` (owned, 3) [N], from the loads that :func:`hold` computed."""
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        support[i, c] = stiffness[i - origin] * u[i - origin, c] - load[k] - contact[i, c]
