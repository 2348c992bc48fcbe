"""What walls, and rows over two nodes, do to the nodes of a block in a step of a batch, and to those that close."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..contact.explicit import Arrivals, PressedWalls, find_beyond, press_nodes
from ..contact.fixed_rows import close_rows
from ..contact.surfaces import Surfaces, wall_gaps
from ..integrators._leapfrog import accelerations, centre
from ..mechanics.compiled import borrowing, kernel
from ..mesh.ordering import NODE_BLOCK
from .batch_supports import put_rates
from .impact import Approach, Touched, join_nodes, stop_nodes, unpressed


class WallArrays(NamedTuple):
    """Walls ``pressed`` and their log, see :mod:`~pfem_petsc.contact.explicit` and
    :mod:`~pfem_petsc.contact.node_walls`; their surfaces ``at_rest``, without displacement, and at the end of the step,
    ``level``; and for walls that move ``motions`` (t, 2, w, 3), displacements and velocities at the start of the first
    step, at the end of each, and of one more, else (0, 2, w, 3)."""

    pressed: PressedWalls
    at_rest: Surfaces
    level: Surfaces
    motions: np.ndarray
    touched: Touched
    present: np.ndarray
    releases: np.ndarray


class Pressed(NamedTuple):
    """Results of :func:`~pfem_petsc.contact.explicit.press_nodes` for all blocks of a step: room for ``nodes``
    (n,), the walls that they are ``touching`` (n, w), their ``places`` (n, 3); ``failure`` (2,): the first of them
    without a place, or -1, and why, and its planes, ``normals`` (w, 3) and ``offsets`` (w,); and the sums of each
    wall, ``force`` (w, 3), ``contacts`` (w,) and ``moment`` (w, 3)."""

    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    failure: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray


@kernel
def new_pressed(n, w):
    """Return room for ``n`` nodes and ``w`` walls. Pages of memory that no node needs are not touched."""
    nodes = np.empty(n if w > 0 else 0, dtype=np.int64)
    touching, places = np.empty((len(nodes), w), dtype=np.bool_), np.empty((len(nodes), 3))
    force, contacts, moment = np.zeros((w, 3)), np.zeros(w, dtype=np.int64), np.zeros((w, 3))
    failure = np.full(2, -1, dtype=np.int64)
    return Pressed(nodes, touching, places, failure, np.empty((w, 3)), np.empty(w), force, contacts, moment)


@kernel
def mark_blocks(marks, nodes, value):
    """Set ``marks`` of the blocks of ``nodes`` to ``value``."""
    for i in nodes:
        marks[i // NODE_BLOCK] = value


@borrowing
def find_pressed(block, walls, free, returning):
    """Write the nodes of a block that lie beyond a wall at ``free`` (3 m,), or rebound if any are ``returning``, to
    the walls' room; return their number."""
    first = NODE_BLOCK * block
    return find_beyond(first, free, walls.pressed, walls.pressed.room, returning)


@kernel
def place_walls(step, walls):
    """Set the surfaces that walls reach one step after a step of the batch, and those at its end."""
    pressed, motions, normals = walls.pressed, walls.motions, walls.at_rest.normals
    for surfaces, end in ((walls.level, step + 1), (pressed.surfaces, step + 2)):
        surfaces.offsets[:], surfaces.centres[:] = walls.at_rest.offsets, walls.at_rest.centres
        for k in range(len(normals)):
            for c in range(3):
                surfaces.offsets[k] += normals[k, c] * motions[end, 0, k, c]
                surfaces.centres[k, c] += motions[end, 0, k, c]
    for k in range(len(normals)):
        for c in range(3):
            pressed.way[k, c] = motions[step + 2, 0, k, c] - motions[step + 1, 0, k, c]


@kernel
def work_of_walls(step, walls, push, force):
    """Return the work of walls over the way that a step of the batch went, with forces (w, 3) at its start and end."""
    work = 0.0
    for k in range(len(force)):
        for c in range(3):
            way = walls.motions[step + 1, 0, k, c] - walls.motions[step, 0, k, c]
            work += 0.5 * (push[k, c] + force[k, c]) * way
            push[k, c] = force[k, c]
    return work


@kernel
def new_arrivals(m, walls):
    """Return room for m nodes."""
    w = len(walls.pressed.way)
    bounces = w if len(walls.pressed.restitution) > 0 else 0
    motion = np.empty((m, 3)), np.empty((m, 3)), np.empty(m), np.empty((m, 3), dtype=np.bool_)
    applies, touching = np.empty((m, w), dtype=np.bool_), np.empty((m, w), dtype=np.bool_)
    memory = np.empty((m, bounces)), np.empty((m, bounces))
    return Arrivals(*motion, applies, touching, *memory, np.empty((0, w, 3)), np.empty((0, w)))


@borrowing
def take_contacts(j, i, walls, given):
    """Set which walls can stop a node i, the j-th one, and what it did in the last step."""
    pressed, touched = walls.pressed, walls.touched
    for c in range(3):
        given.fixed[j, c] = touched.fixed[i, c]
    for k in range(given.applies.shape[1]):
        given.applies[j, k] = pressed.all_nodes[k] or pressed.members[i, k]
        given.touching[j, k] = touched.touching[i, k]
    for k in range(given.rebound.shape[1]):
        given.rebound[j, k], given.arrival[j, k] = pressed.rebound[i, k], pressed.arrival[i, k]


@kernel
def press_block(block, counts, nodes, walls, shared, places_of, out):
    """Press the nodes of a block that :func:`find_pressed` has found, and append them to those of before; ``counts``:
    their numbers. Return the energy that friction dissipates [J].

    ``places_of``: positions and increments of the nodes of the block, flat, of which the latter are corrected; ``out``:
    contact forces (n, 3) [N], and Pressed, to which they are written.
    """
    m, count = counts
    free, u = places_of
    contact, pressed = out
    first = NODE_BLOCK * block
    found = walls.pressed.room[:m].copy()
    places, given = np.empty((m, 3)), new_arrivals(m, walls)
    for j in range(m):
        i = found[j]
        given.stiffness[j] = nodes.stiffness[i]
        take_contacts(j, i, walls, given)
        for c in range(3):
            places[j, c] = free[3 * (i - first) + c]
            given.start[j, c], given.drift[j, c] = shared.x[i, c], shared.h * shared.half[i, c]
    failed, why, planes, total, touching, rubbed = press_nodes(places, given, walls.pressed, pressed)
    for j in range(m):
        i = found[j]
        for c in range(3):
            at = 3 * (i - first) + c
            u[at] += places[j, c] - free[at]
            contact[i, c] += total[j, c]  # rows may press there too
            pressed.places[count + j, c] = places[j, c]
        pressed.nodes[count + j] = i
        for k in range(given.rebound.shape[1]):
            walls.pressed.rebound[i, k], walls.pressed.arrival[i, k] = given.rebound[j, k], given.arrival[j, k]
        for k in range(touching.shape[1]):
            pressed.touching[count + j, k] = touching[j, k]
    if failed >= 0 and (pressed.failure[0] < 0 or why < pressed.failure[1]):
        pressed.failure[0], pressed.failure[1] = count + failed, why
        pressed.normals[:], pressed.offsets[:] = planes.normals[failed], planes.offsets[failed]
    return rubbed


@kernel
def stop_at_walls(nodes, walls, moved, shared, state, on_walls):
    """Return the dissipation of contacts that close [J], and the nodes that are on walls afterwards.

    Velocities and accelerations of the state are written at the nodes that touch walls or have touched them; ``moved``:
    MovingSupports and the step; ``on_walls``: both kinds of nodes.
    """
    x, half, alpha, eta = shared.x, shared.half, shared.alpha, shared.eta
    u, v, a, contact = state.u, state.v, state.a, state.contact
    touched, met = on_walls
    around = join_nodes(met, touched, walls.present)
    for i in around:
        centre(u[i], eta, half[i], v[i])
        accelerations(u[i], alpha, a[i])
    normals, gaps = wall_gaps(around, x, walls.level)
    free_v, free_a = unpressed(around, v, a, contact, nodes, alpha, eta)
    put_rates(*moved, nodes, v, a)
    for j in range(len(around)):
        i = around[j]
        for c in range(3):
            if walls.touched.fixed[i, c]:  # wall forces do not change prescribed components
                free_v[j, c], free_a[j, c] = v[i, c], a[i, c]
    still = np.zeros(walls.pressed.way.shape)
    rates = walls.motions[moved[1] + 1, 1] if len(walls.motions) > 0 else still
    approach = Approach(normals, gaps, free_v, free_a, rates, still)
    counted = np.ones(len(still), dtype=np.bool_)
    return stop_nodes(around, approach, walls.touched, nodes.mass, counted, np.empty(gaps.shape))


@kernel
def sum_rows(rows, pressing):
    """Write the forces on the second nodes of each table to ``rows.totals``, as
    :func:`~pfem_petsc.contact.rows.last_forces` does; ``pressing`` rows have a force."""
    force, normals, place = rows.force, rows.normals, rows.place
    for k in range(len(rows.totals)):
        x = y = z = 0.0
        if pressing > 0:
            for j in range(rows.table_starts[k], rows.table_starts[k + 1]):
                p = place[j]
                x += force[p] * normals[p, 0]
                y += force[p] * normals[p, 1]
                z += force[p] * normals[p, 2]
        rows.totals[k, 0], rows.totals[k, 1], rows.totals[k, 2] = x, y, z


@kernel
def finish_rows(rows, changed, slack, nodes, moved, shared, state):
    """Return the dissipation [J] of rows that close; ``changed`` rows have a force that begins or ends.

    Velocities and accelerations of the state are written at their nodes; ``moved``: MovingSupports and the step.
    """
    x, half, alpha, eta = shared.x, shared.half, shared.alpha, shared.eta
    u, v, a, contact = state.u, state.v, state.a, state.contact
    where, force, closed = rows.where, rows.force, rows.closed
    at, count = np.empty(changed, dtype=np.int64), 0
    ends = np.empty((2, changed, 10))
    for p in rows.place:
        if (force[p] > 0.0) != closed[p]:
            at[count] = p
            count += 1
    for end in range(2):
        around = where[end][at]
        for i in around:
            centre(u[i], eta, half[i], v[i])
            accelerations(u[i], alpha, a[i])
        free_v, free_a = unpressed(around, v, a, contact, nodes, alpha, eta)
        put_rates(*moved, nodes, v, a)
        for m in range(count):
            i = around[m]
            ends[end, m, 9] = nodes.mass[i]
            for c in range(3):
                # rows do not change prescribed components
                fixed = rows.free[end, at[m], c] == 0.0
                ends[end, m, c] = x[i, c]
                ends[end, m, 3 + c] = v[i, c] if fixed else free_v[m, c]
                ends[end, m, 6 + c] = a[i, c] if fixed else free_a[m, c]
    counted = np.ones(len(force), dtype=np.bool_)
    return close_rows(rows, at, ends, counted, slack)
