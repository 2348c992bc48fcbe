"""What the fused loop adds to its steps: impact at walls, impulses, and rows of the history.

Arguments are those of :mod:`~pfem_petsc.stepping.fused_arrays`, arrays with a row for each owned node, and those of the
scheme, ``alpha``, ``eta`` and ``h``.
"""

from __future__ import annotations

import numpy as np

from ..contact.impact_loops import join_nodes, plane_gaps, stop_nodes, unpressed
from ..integrators._leapfrog import centre, kick
from ..mechanics.compiled import kernel
from ..mesh.ordering import NODE_BLOCK
from ..output.sums import HEAD
from .balance_loops import book_row
from .impulses import WALLS, fill_impulses
from .node_loops import accelerations, explicit_increments
from .sum_loops import add_totals, fill_bars, fill_links, fill_probes, fill_walls, fill_works

__all__ = ["complete", "fill_row", "push_particles", "stop_at_walls"]

_HEAD, _KINETIC = HEAD.width, HEAD.first("kinetic_energy")  # constants of the machine code
_CONTACTS, _SLACK = HEAD.first("active_contacts"), HEAD.first("slack_bars")


@kernel
def stop_at_walls(x, half, nodes, walls, alpha, eta, u, v, a, contact, touched, met):
    """Return the dissipation of contacts that close [J], and the nodes that are on walls afterwards.

    ``v`` and ``a`` are written at the nodes that touch walls or have touched them.
    """
    around = join_nodes(met, touched, walls.present)
    for i in around:
        centre(u[i], eta, half[i], v[i])
        accelerations(u[i], alpha, a[i])
    all_normals, gaps = plane_gaps(around, x, walls.normals, walls.offsets)
    free_v, free_a = unpressed(around, v, a, contact, nodes.mass, nodes.damping, alpha, eta)
    for j in range(len(around)):
        i = around[j]
        for c in range(3):
            if walls.fixed[i, c]:  # wall forces do not change prescribed components
                free_v[j, c], free_a[j, c] = v[i, c], a[i, c]
    still = np.zeros(walls.normals.shape)
    return stop_nodes(
        around,
        walls.touching,
        walls.closed,
        all_normals,
        gaps,
        free_v,
        free_a,
        still,
        still,
        nodes.mass,
        walls.fixed,
        walls.restitution,
        np.ones(len(walls.offsets), dtype=np.bool_),
        walls.slack,
        np.empty(gaps.shape),
    )


@kernel
def push_particles(totals, force, links, alpha, h, impulses, u):
    """Advance the particles of the impulses by a step; ``totals`` (6, 3), ``force`` of walls (walls, 3) and ``links``
    (tables, 3) [N]; their increments are written to ``u`` (rows, 3)."""
    first = WALLS + len(force)
    for k in range(len(u)):
        for c in range(3):
            if k < WALLS:
                load = totals[3 + k, c]
            elif k < first:
                load = force[k - WALLS, c]
            else:  # the last rows are those of jumps, which need Python
                load = links[k - first, c] if k < first + len(links) else 0.0
            u[k, c] = load / alpha
    kick(u.reshape(-1), alpha, h, impulses.half.reshape(-1))


@kernel
def complete(n, f, half, nodes, alpha, eta, alone, held, stiffness, u, a, v):
    """Compute the increments of blocks whose forces ``alone`` (blocks,) determine them, and accelerations and
    velocities of all nodes; ``held`` (k,): increments of prescribed components of these blocks [m]."""
    loaded, nothing = len(nodes.external) > 0, np.empty((0, 3))
    for block in range(len(alone)):
        if not alone[block]:
            continue
        first = NODE_BLOCK * block
        last = min(first + NODE_BLOCK, n)
        explicit_increments(
            nodes.external[first:last] if loaded else nothing,
            f[first:last],
            nodes.mass[first:last],
            nodes.damping,
            alpha,
            eta,
            nothing,
            nothing,
            stiffness[first:last],
            u[first:last],
        )
        for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
            u[nodes.support_nodes[k], nodes.support_components[k]] = held[k]
    centre(u.reshape(-1), eta, half.reshape(-1), v.reshape(-1))
    accelerations(u.reshape(-1), alpha, a.reshape(-1))


@kernel
def fill_row(
    x,
    h,
    alpha,
    eta,
    bars,
    nodes,
    probes,
    state,
    impulses,
    push_u,
    wall_sums,
    link_sums,
    touching,
    powers,
    lanes,
    room,
    totals,
    ends,
    ledger,
    row,
):
    """Fill the ledger's sums and the row of a step whose state is complete; return the kinetic energy [J].

    ``push_u``: see :func:`push_particles`; ``wall_sums``: forces, moments, contacts and releases of the walls;
    ``link_sums``: forces of the tables of links; ``touching``: number of nodes with contact forces; ``powers``: of the
    balances before; ``lanes``, ``room``, ``ends`` are workspace.
    """
    n, energies = len(state.v), state.energies
    stored = 0.0
    for k in range(len(energies)):
        stored += energies[k]
    pushed = state.contact if touching > 0 else np.empty((0, 3))
    kinetic = book_row(
        x[:n],
        nodes.mass,
        state.v,
        state.a,
        state.f[:n],
        nodes.external,
        nodes.damping,
        pushed,
        h,
        lanes,
        room,
        totals,
        ends,
    )
    fill_works(ledger, powers, ends, stored)
    add_totals(ledger, totals)
    centre(push_u.reshape(-1), eta, impulses.half.reshape(-1), impulses.v.reshape(-1))
    accelerations(push_u.reshape(-1), alpha, impulses.a.reshape(-1))
    fill_impulses(ledger, impulses.v)
    ledger[_KINETIC] = kinetic
    row[:_HEAD] = ledger
    fill_bars(row, energies)
    row[_CONTACTS] = touching
    if bars.slack >= 0:
        slack = 0.0
        for k in range(bars.counted):
            slack += bars.history[bars.slack, k]
        row[_SLACK] = slack
    at = _HEAD
    force, moment, contacts, releases = wall_sums
    if len(force) > 0:
        at = fill_walls(row, _HEAD + 1, force, moment, impulses.v, contacts, releases)
    at = fill_links(row, at, link_sums, impulses.v, WALLS + len(force))
    reaction = state.support if len(nodes.support_nodes) > 0 else np.empty((0, 3))
    fill_probes(row, at, probes.nodes, probes.places, probes.counts, x, state.v, state.a, state.contact, reaction)
    return kinetic
