"""Compiled loops over owned nodes for explicit steps and the energy ledger, each one pass over the nodal arrays."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["TOTALS", "WORKS", "book_nodes", "explicit_increments", "hold", "react"]

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works that :func:`book_nodes` returns [J], in this order; the first includes supports."""

TOTALS = ("momentum", "angular_momentum", "mass_times_position", "support", "external", "damping")
"""Vectors that :func:`book_nodes` returns, in this order; the last two are sums of forces."""


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
def hold(nodes, components, positions, predictor, stiffness, u, load):
    """Set prescribed components (k,) of ``u`` (owned, 3) to their values; ``load`` (k,) output: force that would move
    them [N]."""
    for k in range(len(nodes)):
        i, c = nodes[k], components[k]
        load[k] = stiffness[i] * u[i, c]
        u[i, c] = positions[k] - predictor[i, c]


@kernel
def react(nodes, components, load, contact, stiffness, u, support):
    """Write support forces into ``support`` (owned, 3) [N], from the loads that :func:`hold` computed."""
    for k in range(len(nodes)):
        i, c = nodes[k], components[k]
        support[i, c] = stiffness[i] * u[i, c] - load[k] - contact[i, c]


@kernel
def book_nodes(
    x0, x1, mass, factor, v, p, support, damping, a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1, totals, works
):
    """Return the kinetic energy [J] at the end of a step; sum over nodes there, and works over dx = x1 - x0 by the mean
    of two sets of forces.

    Parameters
    ----------
    x0, x1 : (owned, 3) positions at start and end
    mass : (owned,); the momentum of a node is ``factor`` (owned,) times ``p``: m v, or M v with factor one
    v, p, support : (owned, 3) at the end
    damping : (owned,), (0,) for none; like ``factor`` it multiplies ``v0`` and ``v1``
    a0, a1, v0, v1, f0, f1, e0, e1, s0, s1, r0, r1 : acceleration, velocity, internal, external, support and contact
        force at start and end of the works' rule (owned, 3); the last six may be (0, 3) for zero, in pairs
    totals : (6, 3) output, see :data:`TOTALS`; external and damping force are those at the end of the works' rule
    works : (5,) output [J], see :data:`WORKS`
    """
    damped = len(damping) > 0
    loaded = len(e0) > 0
    supported = len(s0) > 0
    touched = len(r0) > 0
    kinetic = 0.0
    px = py = pz = lx = ly = lz = mx = my = mz = sx = sy = sz = ex = ey = ez = bx = by = bz = 0.0
    external = contact = dissipated = inertial = internal = 0.0
    for i in range(len(x0)):
        q = factor[i]
        x, y, z = x1[i, 0], x1[i, 1], x1[i, 2]
        a, b, c = q * p[i, 0], q * p[i, 1], q * p[i, 2]
        kinetic += a * v[i, 0] + b * v[i, 1] + c * v[i, 2]
        px += a
        py += b
        pz += c
        lx += y * c - z * b
        ly += z * a - x * c
        lz += x * b - y * a
        m = mass[i]
        mx += m * x
        my += m * y
        mz += m * z
        dx, dy, dz = 0.5 * (x - x0[i, 0]), 0.5 * (y - x0[i, 1]), 0.5 * (z - x0[i, 2])
        inertial += q * (dx * (a0[i, 0] + a1[i, 0]) + dy * (a0[i, 1] + a1[i, 1]) + dz * (a0[i, 2] + a1[i, 2]))
        internal += dx * (f0[i, 0] + f1[i, 0]) + dy * (f0[i, 1] + f1[i, 1]) + dz * (f0[i, 2] + f1[i, 2])
        if damped:
            w = dx * (v0[i, 0] + v1[i, 0]) + dy * (v0[i, 1] + v1[i, 1]) + dz * (v0[i, 2] + v1[i, 2])
            dissipated += damping[i] * w
            bx -= damping[i] * v1[i, 0]
            by -= damping[i] * v1[i, 1]
            bz -= damping[i] * v1[i, 2]
        if loaded:
            external += dx * (e0[i, 0] + e1[i, 0]) + dy * (e0[i, 1] + e1[i, 1]) + dz * (e0[i, 2] + e1[i, 2])
            ex += e1[i, 0]
            ey += e1[i, 1]
            ez += e1[i, 2]
        if supported:
            external += dx * (s0[i, 0] + s1[i, 0]) + dy * (s0[i, 1] + s1[i, 1]) + dz * (s0[i, 2] + s1[i, 2])
            sx += support[i, 0]
            sy += support[i, 1]
            sz += support[i, 2]
        if touched:
            contact += dx * (r0[i, 0] + r1[i, 0]) + dy * (r0[i, 1] + r1[i, 1]) + dz * (r0[i, 2] + r1[i, 2])
    totals[0, 0], totals[0, 1], totals[0, 2] = px, py, pz
    totals[1, 0], totals[1, 1], totals[1, 2] = lx, ly, lz
    totals[2, 0], totals[2, 1], totals[2, 2] = mx, my, mz
    totals[3, 0], totals[3, 1], totals[3, 2] = sx, sy, sz
    totals[4, 0], totals[4, 1], totals[4, 2] = ex, ey, ez
    totals[5, 0], totals[5, 1], totals[5, 2] = bx, by, bz
    works[0], works[1], works[2], works[3], works[4] = external, contact, dissipated, inertial, internal
    return 0.5 * kinetic
