"""Loops over the owned nodes of explicit steps and of the energy ledger: one pass each over the nodal arrays."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["explicit_increments", "node_totals", "node_works"]


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
        k = alpha * mass[i] + (eta * damping[i] if damped else 0.0)
        stiffness[i] = k
        inverse = 1.0 / k
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
def node_totals(mass, factor, x, v, p, support, totals):
    """Kinetic energy [J]; ``totals`` (12,): momentum, angular momentum, mass times position, support force.

    The momentum of a node is ``factor`` times ``p``: m v, or M v with factor one.
    """
    kinetic = 0.0
    px = py = pz = lx = ly = lz = mx = my = mz = sx = sy = sz = 0.0
    for i in range(len(v)):
        q = factor[i]
        a, b, c = q * p[i, 0], q * p[i, 1], q * p[i, 2]
        kinetic += a * v[i, 0] + b * v[i, 1] + c * v[i, 2]
        px += a
        py += b
        pz += c
        lx += x[i, 1] * c - x[i, 2] * b
        ly += x[i, 2] * a - x[i, 0] * c
        lz += x[i, 0] * b - x[i, 1] * a
        m = mass[i]
        mx += m * x[i, 0]
        my += m * x[i, 1]
        mz += m * x[i, 2]
        sx += support[i, 0]
        sy += support[i, 1]
        sz += support[i, 2]
    totals[0], totals[1], totals[2] = px, py, pz
    totals[3], totals[4], totals[5] = lx, ly, lz
    totals[6], totals[7], totals[8] = mx, my, mz
    totals[9], totals[10], totals[11] = sx, sy, sz
    return 0.5 * kinetic


@kernel
def node_works(x0, x1, mass, damping, damped, a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1, works):
    """Works over dx = x1 - x0 by the mean of two sets of forces; ``works`` (5,) [J]: external with supports, contact,
    damping, inertial, internal."""
    external = contact = dissipated = inertial = internal = 0.0
    for i in range(len(x0)):
        m = mass[i]
        for c in range(3):
            dx = 0.5 * (x1[i, c] - x0[i, c])
            external += dx * (e0[i, c] + e1[i, c] + s0[i, c] + s1[i, c])
            contact += dx * (r0[i, c] + r1[i, c])
            inertial += m * dx * (a0[i, c] + a1[i, c])
            internal += dx * (f0[i, c] + f1[i, c])
            if damped:
                dissipated += dx * damping[i] * (v0[i, c] + v1[i, c])
    works[0] = external
    works[1] = contact
    works[2] = dissipated
    works[3] = inertial
    works[4] = internal
