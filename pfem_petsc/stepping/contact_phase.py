"""The contact phase of a step in compiled loops: walls move nodes to where they may be; contacts that close lose
energy."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..columns import HEAD
from ..contact.explicit import Arrivals, PressedWalls, WallSums, find_penetrating, press_nodes
from ..contact.node_walls import compare_contacts
from ..contact.surfaces import Surfaces, wall_gaps
from ..mechanics.compiled import addressed, inlined, record
from ..mesh.ordering import NODE_BLOCK
from .impact import Touched, closed_nodes, join_nodes, stop_nodes
from .phases import INFEASIBLE, WHY, clear_rows, displace, put_rates, rates_of

PUSHED = HEAD.first("contact_work")


@record
class WallArrays(NamedTuple):
    """Walls ``pressed`` and their log, see :mod:`~pfem_petsc.contact.explicit` and
    :mod:`~pfem_petsc.contact.node_walls`; their surfaces ``at_rest``, without displacement, and at the end of the step,
    ``level``; and for walls that move ``motions`` (t, 2, w, 3), displacements and velocities at the start of the first
    step, at the end of each, and of one more, else (0, 2, w, 3); ``free`` (3, n), positions without walls, ``marked``
    (blocks,) and ``present``, workspace; ``releases`` (w,) since the start.
    """

    pressed: PressedWalls
    at_rest: Surfaces
    level: Surfaces
    motions: np.ndarray
    touched: Touched
    present: np.ndarray
    releases: np.ndarray
    free: np.ndarray
    marked: np.ndarray


@record
class ContactNodes(NamedTuple):
    """Results of :func:`~pfem_petsc.contact.explicit.press_nodes` in a step: room for ``nodes`` (n,), the slots of
    walls that they are ``touching`` (n, s), their ``places`` (n, 3); and the sums of each wall, ``force`` (w, 3),
    ``contacts`` (w,) and ``moment`` (w, 3)."""

    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray


def new_contact_nodes(n: int, s: int, force: np.ndarray) -> ContactNodes:
    """Return room for ``n`` nodes and walls with ``s`` slots, whose ``force`` (w, 3) has its own. Pages of memory that
    no node needs are not touched."""
    n = n if len(force) else 0
    touching, places = np.empty((n, s), dtype=bool), np.empty((n, 3))
    contacts, moment = np.zeros(len(force), dtype=np.int64), np.zeros_like(force)
    return ContactNodes(np.empty(n, dtype=np.int64), touching, places, force, contacts, moment)


@addressed
def place_walls(s, step):
    """Set the surfaces that walls reach one step after a step, and those at its end."""
    walls = s.walls
    pressed, motions, normals = walls.pressed, walls.motions, walls.at_rest.normals
    for surfaces, end in ((walls.level, step + 1), (pressed.surfaces, step + 2)):
        offsets, centres = surfaces.offsets, surfaces.centres
        for k in range(len(normals)):
            offsets[k], way = walls.at_rest.offsets[k], motions[end, 0, pressed.wall_of[k]]
            for c in range(3):
                offsets[k] += normals[k, c] * way[c]
                centres[k, c] = walls.at_rest.centres[k, c] + way[c]
    for k in range(len(normals)):
        wall = pressed.wall_of[k]
        for c in range(3):
            pressed.way[k, c] = motions[step + 2, 0, wall, c] - motions[step + 1, 0, wall, c]


@addressed
def work_of_walls(s, step):
    """Add the work of walls over the way that a step went, with forces (w, 3) at its start and end."""
    walls, push, force, work = s.walls, s.push, s.pressed.force, 0.0
    for k in range(len(force)):
        for c in range(3):
            way = walls.motions[step + 1, 0, k, c] - walls.motions[step, 0, k, c]
            work += 0.5 * (push[k, c] + force[k, c]) * way
            push[k, c] = force[k, c]
    s.ledger[PUSHED] += work


@inlined
def _arrivals(found, nodes, motion, walls):
    """Return what pressing needs of nodes (m,)."""
    free = np.empty((len(found), 3))
    pressed, touched, h = walls.pressed, walls.touched, motion.h
    m, w = len(found), len(pressed.way)
    bounces = w if len(pressed.restitution) > 0 else 0
    start, ways, drift, stiffness = np.empty((m, 3)), np.empty((m, w, 3)), np.empty((m, 3)), np.empty(m)
    fixed, applies = np.empty((m, 3), dtype=np.bool_), np.empty((m, w), dtype=np.bool_)
    touching, rebound, arrival = np.empty((m, w), dtype=np.bool_), np.empty((m, bounces)), np.empty((m, bounces))
    for j in range(m):
        i = found[j]
        stiffness[j] = nodes.stiffness[i]
        for c in range(3):
            free[j, c], start[j, c] = walls.free[c, i], motion.x[c, i]
            drift[j, c] = h * motion.half[c, i] - motion.u[c, i]
            fixed[j, c] = touched.fixed[i, c]
        for k in range(w):
            applies[j, k] = pressed.all_nodes[k] or pressed.members[i, k]
            touching[j, k] = touched.touching[i, k]
            for c in range(3):
                ways[j, k, c] = pressed.way[k, c]
        for k in range(bounces):
            rebound[j, k], arrival[j, k] = pressed.rebound[i, k], pressed.arrival[i, k]
    none = np.empty((0, w, 3)), np.empty((0, w))
    return Arrivals(free, start, ways, drift, stiffness, fixed, applies, touching, rebound, arrival, *none)


@inlined
def _mark(marked, nodes, value):
    """Set the marks of the blocks of nodes."""
    for i in nodes:
        marked[i // NODE_BLOCK] = value


@inlined
def find_beyond(motion, walls, out, contacts):
    """Clear the sums of walls, write the positions without them, and find the nodes that are beyond walls there, or
    rebound; return their number."""
    free, h, pressed = walls.free, motion.h, walls.pressed
    for c in range(3):
        there, where, speed = free[c], motion.x[c], motion.half[c]
        for i in range(len(there)):
            there[i] = where[i] + h * speed[i]
    clear_rows(out.force)
    clear_rows(out.moment)
    for k in range(len(out.contacts)):
        out.contacts[k] = 0
    if len(pressed.restitution) > 0:
        _mark(walls.marked, contacts.touched, np.bool_(True))
        _mark(walls.marked, contacts.met, np.bool_(True))
    m = find_penetrating(free, pressed, walls.marked)
    if len(pressed.restitution) > 0:
        _mark(walls.marked, contacts.touched, np.bool_(False))
        _mark(walls.marked, contacts.met, np.bool_(False))
    return m


@inlined
def note_contacts(m, walls, out, contacts):
    """Take account of the contacts of ``m`` nodes."""
    contacts.near = out.nodes[:m]
    more, contacts.touched = compare_contacts(
        walls.touched.touching,
        contacts.touched,
        contacts.near,
        out.touching,
        walls.present,
        walls.releases,
        walls.pressed.wall_of,
    )
    contacts.changes += more


@cache
def press_walls(curved: Any, rough: Any, several: Any) -> Any:
    """Make the phase that moves nodes beyond walls onto them, for walls of a kind, see
    :func:`~pfem_petsc.contact.explicit.kind_of`."""

    @addressed
    def press(s, step):
        nodes, motion, walls, out, contacts = s.nodes, s.motion, s.walls, s.pressed, s.contacts
        free, pressed, m = walls.free, walls.pressed, find_beyond(motion, walls, out, contacts)
        if m > 0:
            given, sums = (
                _arrivals(pressed.room[:m], nodes, motion, walls),
                WallSums(out.force, out.contacts, out.moment),
            )
            failed, why, found, total, touching, contacts.friction = press_nodes(
                given, pressed, sums, curved, rough, several
            )
            for j in range(m):
                i = pressed.room[j]
                out.nodes[j] = i
                for c in range(3):
                    displace(c, i, found.x[j, c] - free[c, i], nodes, motion, s.sums)
                    motion.contact[i, c] += total[j, c]  # rows may press there too
                    out.places[j, c] = found.x[j, c]
                for k in range(given.rebound.shape[1]):
                    pressed.rebound[i, k], pressed.arrival[i, k] = given.rebound[j, k], given.arrival[j, k]
                for k in range(touching.shape[1]):
                    out.touching[j, k] = touching[j, k]
            if failed >= 0:
                s.course[INFEASIBLE], s.course[WHY] = failed, why
        note_contacts(m, walls, out, contacts)

    return press


@addressed
def close_on_walls(s, step):
    """Find the energy that nodes lose which close on walls, and which nodes are on walls."""
    contacts, walls = s.contacts, s.walls
    if len(contacts.met) == 0 and len(contacts.touched) == 0:
        return
    around = join_nodes(contacts.met, contacts.touched, walls.present)
    normals, gaps = wall_gaps(around, s.motion.x.T, walls.level)
    speeds, towards, moves = np.zeros(gaps.shape), np.zeros(gaps.shape), len(walls.motions) > 0
    v, a, motion = s.state.v, s.state.a, s.motion
    for i in around:
        rates_of(i, motion, v, a)
    put_rates(s.moving, step, s.held, v, a)
    for j in range(len(around)):
        i = around[j]
        for c in range(3):
            # wall forces do not change prescribed components
            u = 0.0 if walls.touched.fixed[i, c] else motion.contact[i, c] / s.nodes.stiffness[i]
            free_v, free_a = v[i, c] - 0.5 / motion.h * u, a[i, c] - u / (motion.h * motion.h)
            for k in range(gaps.shape[1]):
                rate = walls.motions[step + 1, 1, k, c] if moves else 0.0
                speeds[j, k] += normals[j, k, c] * (free_v - rate)
                towards[j, k] -= normals[j, k, c] * free_a
    contacts.impact += stop_nodes(around, normals, gaps, speeds, towards, walls.touched, s.nodes.mass)
    contacts.met = closed_nodes(around, walls.touched)
