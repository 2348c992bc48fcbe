"""Surfaces of triangles, walls that turn, and those with mass in compiled steps: loops find the nodes near them, which
Python presses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..contact.surfaces import OTHER, Surfaces, tangent
from ..mechanics.compiled import addressed, inlined, record
from ..tolerances import BEYOND
from .contact_phase import PUSHED, find_beyond, note_contacts
from .impact import closed_nodes, join_nodes
from .phases import LOST, UNSOLVED, displace, put_rates, rates_of

if TYPE_CHECKING:
    from ..contact.contact import Contact

SOLVE, CLOSE, TOUCH, MOVE, PRESS, STOP = range(6)
"""What a call of Python does: solve rows, find the energy that they lose, add the forces of bars that touch; begin the
step of walls with mass, press nodes, or find the energy that they lose and end the step of walls with mass."""

AGAIN = 1
"""What a call returns if walls with mass may meet more nodes than those found."""

FOUND, SUSPECTS = range(2)  # places of numbers of nodes


@record
class CalledWalls(NamedTuple):
    """Walls (w,), of which Python presses some (owned nodes n, slots s).

    Attributes
    ----------
    called : (w,) bool, those that it presses; at_rest : Surfaces of these at rest, ``OTHER`` for those in boxes
    boxes : (w, 6) lower and upper corners of surfaces of triangles at rest [m]
    first : (w,) the first slot of each
    slack : distance from a wall below which it may stop a node [m]
    massive : whether walls have mass, on all ranks; reach : (w, 2) how far these may move [m] and turn [rad] by contact
        in a step, zero for others; pivots : (w, 3) their centres without contact at its end [m]
    poses, angles : (t, w, 12) and (t, w) [rad], see :meth:`~pfem_petsc.contact.wall_motion.WallMotion.turns`, at the
        start of the first step, the end of each, and of one more
    axes, centres : (w, 3) about which walls turn; torques : (w, 3) at the start of a step, first components [N m]; (0,
        3) if none turns
    counts : (2,) numbers of nodes that are known to be beyond walls, and of others in ``nodes`` (n,)
    free : (n, 3) positions to which nodes move [m]
    force : (n, 3) on pressed nodes [N]
    losses : (2,) energy that friction of these dissipates, and that closing contacts lose [J]
    """

    called: np.ndarray
    at_rest: Surfaces
    boxes: np.ndarray
    first: np.ndarray
    slack: float
    massive: bool
    reach: np.ndarray
    pivots: np.ndarray
    poses: np.ndarray
    angles: np.ndarray
    axes: np.ndarray
    centres: np.ndarray
    torques: np.ndarray
    counts: np.ndarray
    nodes: np.ndarray
    free: np.ndarray
    force: np.ndarray
    losses: np.ndarray


def new_called_walls(contact: Contact, torques: np.ndarray) -> CalledWalls:
    """Return the walls of a rank, with room for their ``torques``."""
    w, called = len(contact.walls), contact.called
    n = len(contact.members) if called.any() else 0
    boxes = np.zeros((w, 6))
    for k in contact.surfaces_of_triangles:
        triangles = contact.walls[k].triangles
        boxes[k] = triangles.boxes[1] + np.repeat([-1.0, 1.0], 3) * triangles.limits[0, 1]
    masses = contact.motion.bodies.any, np.zeros((w, 2)), np.zeros((w, 3))
    times = np.zeros((0, w, 12)), np.zeros((0, w))
    sets = np.zeros(2, dtype=np.int64), np.empty(n, dtype=np.int64)
    slack = 4.0 * BEYOND * contact.size
    turns = *contact.motion.pivots, torques
    shapes = called, contact.at_rest, boxes, contact.first
    return CalledWalls(*shapes, slack, *masses, *times, *turns, *sets, *np.empty((2, n, 3)), np.zeros(2))


@inlined
def _at_rest(pose, x, y, z):
    """Return where a point of a wall is at rest."""
    x, y, z = x - pose[9], y - pose[10], z - pose[11]
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@inlined
def _may_stop(k, called, starts, ends, i, step):
    """Return whether wall k may stop node i on its way from ``starts`` to ``ends`` (3, n)."""
    end, slack, square = _at_rest(called.poses[step + 2, k], ends[0, i], ends[1, i], ends[2, i]), called.slack, 0.0
    if called.reach[k, 0] > 0.0:
        for c in range(3):
            square += (ends[c, i] - called.pivots[k, c]) ** 2
        slack += called.reach[k, 0] + called.reach[k, 1] * math.sqrt(square)
    if called.at_rest.radii[k] != OTHER:
        return tangent(k, called.at_rest, end)[1] < slack
    start = _at_rest(called.poses[step + 1, k], starts[0, i], starts[1, i], starts[2, i])
    box, meets = called.boxes[k], True
    for c in range(3):
        meets = meets and min(start[c], end[c]) <= box[3 + c] + slack and max(start[c], end[c]) >= box[c] - slack
    return meets


@inlined
def _suspect(s, step):
    """Write the nodes that walls may stop; return their number."""
    called, pressed, n, m = s.called_walls, s.walls.pressed, len(s.called_walls.nodes), 0
    for i in range(n):
        for k in range(len(called.called)):
            slot = called.first[k]
            applies = called.called[k] and (pressed.all_nodes[slot] or pressed.members[i, slot])
            if applies and _may_stop(k, called, s.motion.x, s.walls.free, i, step):
                called.nodes[m] = i
                m += 1
                break
    return m


@inlined
def _show(i, s):
    """Write the state of node i at the end of a step, before its balance, and where it would move."""
    motion = s.motion
    for c in range(3):
        s.state.x[i, c], s.called_walls.free[i, c] = motion.x[c, i], s.walls.free[c, i]
        s.state.half[i, c] = motion.half[c, i] - motion.u[c, i] / motion.h


@addressed
def press_called(s, step):
    """Find the nodes that walls may stop, and have Python move those that are beyond walls onto them."""
    nodes, motion, walls, out, contacts, called = s.nodes, s.motion, s.walls, s.pressed, s.contacts, s.called_walls
    counts = called.counts
    counts[FOUND] = find_beyond(motion, walls, out, contacts)
    if called.massive and s.calls.python(step, MOVE) != 0:
        s.course[UNSOLVED] = LOST
        return
    found, answer, m = counts[FOUND], AGAIN, 0
    while answer == AGAIN:
        counts[SUSPECTS], answer = _suspect(s, step), 0
        if found > 0 or counts[SUSPECTS] > 0 or called.massive:
            for i in walls.pressed.room[:found]:
                _show(i, s)
            for i in called.nodes[: counts[SUSPECTS]]:
                _show(i, s)
            answer = s.calls.python(step, PRESS)
            s.course[UNSOLVED] = answer
            m = counts[FOUND] if answer == 0 else 0
            contacts.friction = called.losses[0]
    for j in range(m):
        i = out.nodes[j]
        for c in range(3):
            displace(c, i, out.places[j, c] - walls.free[c, i], nodes, motion, s.sums)
            motion.contact[i, c] += called.force[j, c]
    note_contacts(m, walls, out, contacts)


@addressed
def close_on_called(s, step):
    """Find the energy that nodes lose which close on walls, and which nodes are on walls, as
    :func:`~pfem_petsc.stepping.contact_phase.close_on_walls` does."""
    contacts, touched, called, state = s.contacts, s.walls.touched, s.called_walls, s.state
    if len(contacts.met) == 0 and len(contacts.touched) == 0 and not called.massive:
        return
    around, m = join_nodes(contacts.met, contacts.touched, s.walls.present), 0
    for i in around:
        changes = False
        for k in range(touched.closed.shape[1]):
            changes = changes or touched.touching[i, k] != touched.closed[i, k]
        if changes:
            called.nodes[m] = i
            m += 1
            rates_of(i, s.motion, state.v, state.a)
            for c in range(3):
                state.x[i, c] = s.motion.x[c, i]
    called.counts[SUSPECTS] = m
    if m > 0 or called.massive:
        put_rates(s.moving, step, s.held, state.v, state.a)
        if s.calls.python(step, STOP) != 0:
            s.course[UNSOLVED] = LOST
            return
        contacts.impact += called.losses[1]
    contacts.met = closed_nodes(around, touched)


@addressed
def work_of_turns(s, step):
    """Add the work of walls that turn by an angle in a step, with moments about their axes at its start and end."""
    called, pressed, motions, work = s.called_walls, s.pressed, s.walls.motions, 0.0
    for k in range(len(called.torques)):
        torque = 0.0
        for c in range(3):
            one, other = (c + 1) % 3, (c + 2) % 3
            x = called.centres[k, one] + motions[step + 1, 0, k, one]
            y = called.centres[k, other] + motions[step + 1, 0, k, other]
            moment = pressed.moment[k, c] - (x * pressed.force[k, other] - y * pressed.force[k, one])
            torque += called.axes[k, c] * moment
        work += 0.5 * (called.torques[k, 0] + torque) * (called.angles[step + 1, k] - called.angles[step, k])
        called.torques[k, 0] = torque
    s.ledger[PUSHED] += work
