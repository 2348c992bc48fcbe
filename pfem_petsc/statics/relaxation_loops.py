"""Compiled loops over owned nodes and local bars for a pseudo-step of dynamic relaxation."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["add_up", "free_residual", "move_freely", "node_stiffness", "shortest_bars"]

RESIDUAL, WEIGHTED, POWER, KINETIC, SUPPORTS, WALLS, BARS, FAILED, WIDTH = range(9)
"""Sums over all nodes: squares of the residual [N2], the same over masses, power, twice the kinetic energy, squares of
the forces of supports, of walls, of bars [N2], ranks that failed."""


@kernel
def free_residual(external, f, fixed, r):
    """External less internal force into ``r`` (owned, 3) [N], zero on prescribed components; gives the sum of squares
    there, which supports take [N2]."""
    taken = 0.0
    for i in range(len(r)):
        for c in range(3):
            r[i, c] = external[i, c] - f[i, c]
            if fixed[i, c]:
                taken += r[i, c] * r[i, c]
                r[i, c] = 0.0
    return taken


@kernel
def add_up(r, v, mass, sums):
    """Sums of r.r [N2], r.r/m, r.v and m v.v over the nodes into ``sums`` (4,)."""
    plain = weighted = power = kinetic = 0.0
    for i in range(len(r)):
        square = r[i, 0] * r[i, 0] + r[i, 1] * r[i, 1] + r[i, 2] * r[i, 2]
        plain += square
        weighted += square / mass[i]
        power += r[i, 0] * v[i, 0] + r[i, 1] * v[i, 1] + r[i, 2] * v[i, 2]
        kinetic += mass[i] * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
    sums[0], sums[1], sums[2], sums[3] = plain, weighted, power, kinetic


@kernel
def move_freely(r, mass, keep, push, step, reach, v, u):
    """v = keep v + push r/m, and u = step v, both (owned, 3); a node's u is at most ``reach`` (owned,) [m]."""
    for i in range(len(r)):
        share = push / mass[i]
        square = 0.0
        for c in range(3):
            v[i, c] = keep * v[i, c] + share * r[i, c]
            u[i, c] = step * v[i, c]
            square += u[i, c] * u[i, c]
        if square > reach[i] * reach[i]:
            factor = reach[i] / square**0.5
            for c in range(3):
                v[i, c] *= factor
                u[i, c] *= factor


@kernel
def shortest_bars(bars, rest, share, reach):
    """Share of the shortest bar of each node into ``reach`` (local,) [m]."""
    for k in range(len(bars)):
        for end in range(2):
            i = bars[k, end]
            reach[i] = min(reach[i], share * rest[k])


@kernel
def node_stiffness(x, bars, stored, axial, counted, blocks, bound):
    """Upper bound of the eigenvalues of each node's diagonal block of the stiffness into ``bound`` (owned,) [N/m].

    The largest row sum bounds them, and so does the Frobenius norm, which does not depend on the axes. A bar counts
    with the larger of its present axial stiffness and ``axial`` (b,), that of its law at most, and with its geometric
    stiffness N/l where it is under tension. ``stored`` (5, b) is that of ``Bars.linearise``, ``blocks`` (local, 6) is
    workspace. Gives the sum of N.N over the bars ``counted`` here [N2].
    """
    blocks[:] = 0.0
    forces = 0.0
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        n0, n1, n2 = stored[0, k], stored[1, k], stored[2, k]
        geometric = max(stored[4, k], 0.0)
        along = max(stored[3, k] + stored[4, k], axial[k]) - geometric
        along = max(along, 0.0)
        for i in (a, b):
            blocks[i, 0] += along * n0 * n0 + geometric
            blocks[i, 1] += along * n1 * n1 + geometric
            blocks[i, 2] += along * n2 * n2 + geometric
            blocks[i, 3] += along * n0 * n1
            blocks[i, 4] += along * n1 * n2
            blocks[i, 5] += along * n2 * n0
        if counted[k]:
            square = (x[b, 0] - x[a, 0]) ** 2 + (x[b, 1] - x[a, 1]) ** 2 + (x[b, 2] - x[a, 2]) ** 2
            forces += stored[4, k] * stored[4, k] * square
    for i in range(len(bound)):
        xy, yz, zx = abs(blocks[i, 3]), abs(blocks[i, 4]), abs(blocks[i, 5])
        rows = max(blocks[i, 0] + xy + zx, blocks[i, 1] + xy + yz, blocks[i, 2] + yz + zx)
        squares = blocks[i, 0] ** 2 + blocks[i, 1] ** 2 + blocks[i, 2] ** 2 + 2.0 * (xy * xy + yz * yz + zx * zx)
        bound[i] = min(rows, squares**0.5)
    return forces
