"""The loop of a batch: steps of central differences in one compiled call, block of nodes by block of nodes.

A block is moved shortly before its first bar, and finished after its last one, while it is in the cache. Blocks are
those of the order of nodes; the bars of a block reach its own nodes and those of some blocks behind it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ..columns import BAR_ENERGIES, HEAD, PAIR, PROBED, WALL
from ..contact.explicit import Arrivals, FlatWalls, find_beyond, press_nodes
from ..contact.fixed_rows import close_rows, solve_rows
from ..contact.node_walls import compare_contacts
from ..integrators._leapfrog import accelerations, advance, advance_loaded, centre, kick, move
from ..mechanics.compiled import borrowing, calls, kernel
from ..mechanics.elements import PULLED, clear_energies, first_inverted, sum_energies
from ..mechanics.loads import LoadSchedule, set_forces
from ..mechanics.runs import copy, join_components, new_rows, slide_planes, split_components
from ..mechanics.tuples import ROW
from ..mesh.ordering import NODE_BLOCK
from .batch_supports import (
    MovingSupports,
    SpringArrays,
    add_ends_of_supports,
    add_inertia,
    add_springs,
    place_supports,
    put_rates,
)
from .impact import Approach, Touched, join_nodes, plane_gaps, stop_nodes, unpressed
from .impulses import IN_COLUMNS, SUPPORT, WALLS
from .ledger_loops import (
    CONTACT,
    DAMPING,
    ENDS,
    EXTERNAL,
    INERTIAL,
    INTERNAL,
    LANES,
    REACTIONS,
    WIDE,
    WORKS,
    Acting,
    EndArrays,
    add_drags,
    add_ends,
    add_loads,
    add_powers,
    add_sparse_forces,
    add_sparse_powers,
    clear_ends,
    clear_forces,
    clear_sums,
    new_sums,
    spread,
    start_of_step,
    sum_balance,
    sum_ends,
)


class BarArrays(NamedTuple):
    """The bars of a batch, by sections.

    Attributes
    ----------
    sections : (s, 3) int64, addresses of the :class:`~pfem_petsc.mechanics.elements.PulledBars` of each section, and of
        the loops of its law, see :func:`~pfem_petsc.mechanics.elements.batch_pulls`
    parts : (s, blocks + 2) int64, the first chunk of each block of nodes, of the bars that other ranks count, and the
        end
    padded_parts : the same of groups of padded runs; (s, 0) if not all sections have such
    places, n_energies : (s, k) and (s,) int64, see :func:`~pfem_petsc.mechanics.elements.sum_energies`
    work_rows : number of rows of the largest workspace
    keeps : whether laws have a history
    spring_place : index of the energy of springs among those of bars
    reach : how many blocks of nodes beyond its own the bars of a block reach
    meeting : the first block that waits for messages
    ends, watched : see ``Bars``
    planes, pulls : (3 stride,), positions and forces by components, of a window of the nodes
    """

    sections: np.ndarray
    parts: np.ndarray
    padded_parts: np.ndarray
    places: np.ndarray
    n_energies: np.ndarray
    work_rows: int
    keeps: bool
    spring_place: int
    reach: int
    meeting: int
    ends: np.ndarray
    watched: np.ndarray
    planes: np.ndarray
    pulls: np.ndarray


class NodeArrays(NamedTuple):
    """Constant arrays at the nodes; ``damping`` (0,) and ``external`` (0, 3) if there are none; ``stiffness`` (n,) of
    the balance and its inverse; ``support_starts`` (blocks + 1,) the first prescribed component of each block of nodes,
    which are sorted by node."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    inverses: np.ndarray
    external: np.ndarray
    support_nodes: np.ndarray
    support_components: np.ndarray
    support_positions: np.ndarray
    support_starts: np.ndarray


class WallArrays(NamedTuple):
    """Flat walls and their log, see :mod:`~pfem_petsc.contact.explicit` and :mod:`~pfem_petsc.contact.node_walls`;
    their ``origins`` (w,), offsets without displacement [m]; and for walls that move ``motions`` (t, 2, w, 3),
    displacements and velocities at the start of the first step, at the end of each, and of one more, else (0, 2, w,
    3)."""

    flat: FlatWalls
    origins: np.ndarray
    motions: np.ndarray
    touched: Touched
    present: np.ndarray
    releases: np.ndarray


class BlockArrays(NamedTuple):
    """What the passes over blocks of nodes share: numbers of the scheme, see
    :mod:`~pfem_petsc.integrators._leapfrog`; positions ``x`` (local, 3) and velocities at half steps ``half`` (n, 3);
    ``inverses`` (n,) of the stiffness; ``factors``, ``speeds`` and ``drag``
    (3 NODE_BLOCK,) buffers of a block, the last one empty without damping; for prescribed components the increments
    ``held`` (k,) [m] and ``load`` (k,), the forces that would move them [N]; reactions ``support`` (n, 3) [N];
    ``lanes``, the sums of the balance, see :mod:`~pfem_petsc.stepping.ledger_loops`; and room for ``ends`` of steps."""

    h: float
    alpha: float
    eta: float
    x: np.ndarray
    half: np.ndarray
    inverses: np.ndarray
    factors: np.ndarray
    speeds: np.ndarray
    drag: np.ndarray
    held: np.ndarray
    load: np.ndarray
    support: np.ndarray
    lanes: np.ndarray
    ends: EndArrays


class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


class StateArrays(NamedTuple):
    """Arrays (n, 3) of the state, and the increments ``u`` of the balance. Wall forces are zero except at the nodes
    that touch walls; support forces are written at prescribed components alone."""

    f: np.ndarray
    a: np.ndarray
    v: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    u: np.ndarray


class ProbeArrays(NamedTuple):
    """Nodes (p,) of probes, ascending; the first one of each block of nodes, ``starts`` (blocks + 1,); and their places
    in ``order`` (p,)."""

    nodes: np.ndarray
    starts: np.ndarray
    order: np.ndarray


class BatchData(NamedTuple):
    """All that a batch reads and writes: the step [s]; positions (local, 3), those of the previous step, which are
    computed for the last step alone, and velocities at half steps (n, 3); records of arrays; the sums of the ledger, of
    which the dissipation by impact is added to; works (5,) of all balances; particles of impulses; contacts that have
    changed since the last row; the energy that friction dissipates in the next step [J]; forces of walls (w, 3) at the
    start [N]; and this rank's shares (m, width) of the rows of the steps that are due, and at last of
    the last step if it is not, see :class:`~pfem_petsc.columns.Share`."""

    h: float
    x: np.ndarray
    before: np.ndarray
    half: np.ndarray
    bars: BarArrays
    springs: SpringArrays
    nodes: NodeArrays
    moving: MovingSupports
    loads: LoadSchedule
    walls: WallArrays
    rows: NamedTuple
    messages: NamedTuple
    state: StateArrays
    ledger: np.ndarray
    powers: np.ndarray
    impulses: ImpulseArrays
    probes: ProbeArrays
    changes: int
    friction: float
    push: np.ndarray
    shares: np.ndarray


class Made(NamedTuple):
    """Outcome of a batch.

    ``done``: number of steps made; ``recorded``: number of shares of rows; ``lost``: error code of MPI. In the last
    step: ``changed``: number of bars that changed their state of rupture; ``failed``, ``turned``: the first bar that
    collapsed, and that went through zero length, or -1; ``infeasible``: index in ``near`` of a node that no position
    satisfies, or -1, with the ``offsets`` of its planes, or if it is ``jammed`` one whose friction was not found;
    ``force``, ``contacts``, ``moment``: sums of the walls; ``near``: nodes with wall forces, the walls that they are
    ``touching``, and their ``places``; ``touched``, ``met``: nodes that touch walls, and that have touched them and not
    left; ``pressing``: number of nodes with contact forces; ``changes``: contacts that closed or opened since the last
    row; and ``friction``: the energy that it dissipates in the next step [J].
    """

    done: int
    recorded: int
    lost: int
    changed: int
    failed: int
    turned: int
    infeasible: int
    jammed: bool
    offsets: np.ndarray
    force: np.ndarray
    contacts: np.ndarray
    moment: np.ndarray
    near: np.ndarray
    touching: np.ndarray
    places: np.ndarray
    touched: np.ndarray
    met: np.ndarray
    pressing: int
    changes: int
    friction: float


# constants of the machine code
_KINETIC, _EXTERNAL, _PUSHED, _DAMPING, _RUBBED, _IMPACT, _NUMERICAL, _MOMENTA, _SUPPORT, _IMPULSES, _PRESSING = map(
    HEAD.first,
    (
        "kinetic_energy",
        "external_work",
        "contact_work",
        "damping_dissipation",
        "friction_dissipation",
        "impact_dissipation",
        "numerical_dissipation",
        "momentum",  # followed by angular momentum and centre of mass
        "support_force",
        "external_impulse",  # followed by those of supports and damping
        "active_contacts",
    ),
)
_BARS, _CHANGES, _WALL, _PAIR, _PROBED = HEAD.indices(BAR_ENERGIES), HEAD.width, WALL.width, PAIR.width, len(PROBED)
_WALL_FORCE, _WALL_MOMENT, _WALL_IMPULSE, _WALL_JUMP, _CONTACTS, _RELEASES = map(
    WALL.first, ("force", "moment", "impulse", "jump_impulse", "contacts", "releases")
)
_PAIR_FORCE, _PAIR_IMPULSE, _PAIR_JUMP = map(PAIR.first, ("force", "impulse", "jump_impulse"))


@borrowing
def move_block(block, shared, f, padded, bars, base):
    """Move the nodes of a block, and set their forces to zero; with ``padded`` runs those of :func:`split_block`."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where = shared.x[first:last].reshape(-1)
    move(where, shared.h, shared.half[first:last].reshape(-1))
    if padded:
        split_block(first, last, shared.x, bars.planes, bars.pulls, base)
        return
    sums = f[first:last].reshape(-1)
    for j in range(len(sums)):
        sums[j] = 0.0


@borrowing
def split_block(first, last, x, planes, pulls, base):
    """Write the positions of nodes [first, last) to ``planes`` (3 stride,), which begin at node ``base``, and set their
    forces in ``pulls`` (3 stride,) to zero."""
    stride = len(planes) // 3
    split_components(x, first, last - first, planes, stride, base)
    for c in range(3):
        part = pulls[c * stride + first - base : c * stride + last - base]
        for i in range(len(part)):
            part[i] = 0.0


@borrowing
def join_block(block, n, pulls, base, f, start):
    """Write the forces of the nodes of a block from ``pulls``."""
    first = NODE_BLOCK * block
    join_components(pulls, base, first, f[first - start : min(first + NODE_BLOCK, n) - start])


@borrowing
def hold_still(block, nodes, shared, f, inverse):
    """Write the increments of the prescribed components of a block without damping and contact to ``shared.held`` (k,),
    and their reactions to ``shared.support`` (owned, 3) [N]; set their inverse stiffness to zero in ``inverse`` (3 m,).
    This array and the forces ``f`` (m, 3) are those of the block."""
    components, positions, external = nodes.support_components, nodes.support_positions, nodes.external
    held, support, x, half = shared.held, shared.support, shared.x, shared.half
    origin, loaded = NODE_BLOCK * block, len(external) > 0
    for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
        i, c = nodes.support_nodes[k], components[k]
        stiffness = nodes.stiffness[i]
        pull = f[i - origin, c]
        force = external[i, c] - pull if loaded else -pull
        free = stiffness * (force * (1.0 / stiffness))
        held[k] = positions[k] - (x[i, c] + shared.h * half[i, c])
        support[i, c] = stiffness * held[k] - free
        inverse[3 * (i - origin) + c] = 0.0


@borrowing
def advance_block(block, nodes, shared, f, start):
    """Finish the step of a block without walls and damping in one pass: forces alone determine its increments."""
    h, alpha, eta, half, held, support = shared.h, shared.alpha, shared.eta, shared.half, shared.held, shared.support
    lanes = shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(half))
    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
    components = nodes.support_components
    here, factor = shared.speeds[: 3 * (last - first)], shared.factors[: 3 * (last - first)]
    forces = f[first - start : last - start]
    spread(shared.inverses[first:last], factor)
    hold_still(block, nodes, shared, forces, factor)
    force, ahead = forces.reshape(-1), half[first:last].reshape(-1)
    if len(nodes.external) > 0:
        load = nodes.external[first:last].reshape(-1)
        advance_loaded(force, load, factor, (alpha, eta, h), ahead, here, lanes[INTERNAL])
        add_loads(load, here, lanes)
    else:
        advance(force, factor, alpha, eta, h, ahead, lanes[INTERNAL])
    for k in range(begin, end):
        half[nodes.support_nodes[k], components[k]] += h * (alpha * held[k])
    add_sparse_forces(begin, end, nodes.support_nodes, components, support, lanes[REACTIONS])


@borrowing
def solve_block(block, nodes, shared, f, start, free, u):
    """Compute the increments ``u`` (3 m,) of a block without contact, and its ``free`` positions (3 m,); those of its
    prescribed components are written to ``shared`` too."""
    h = shared.h
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where, speed = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    force = f[first - start : last - start].reshape(-1)
    factor = shared.factors[: len(u)]
    damped = len(nodes.damping) > 0
    if len(nodes.external) > 0:
        given = nodes.external[first:last].reshape(-1)
        for j in range(len(u)):
            u[j] = given[j] - force[j]
    else:
        for j in range(len(u)):
            u[j] = -force[j]
    if damped:
        spread(nodes.damping[first:last], factor)
        for j in range(len(u)):
            u[j] -= factor[j] * speed[j]
    spread(shared.inverses[first:last], factor)
    for j in range(len(u)):
        u[j] *= factor[j]
        free[j] = where[j] + h * speed[j]
    for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
        i = nodes.support_nodes[k]
        j = 3 * (i - first) + nodes.support_components[k]
        shared.load[k] = nodes.stiffness[i] * u[j]
        u[j] = shared.held[k] = nodes.support_positions[k] - free[j]
    for j in range(len(u)):
        free[j] += u[j]


@borrowing
def finish_block(block, nodes, shared, f, start, contact, u):
    """Finish the step of a block from its increments ``u`` (3 m,): reactions, velocities half a step later, and powers.

    The velocities of the balance remain in ``shared.speeds``.
    """
    alpha, eta, support, lanes = shared.alpha, shared.eta, shared.support, shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
    damped = len(shared.drag) > 0
    for k in range(begin, end):
        i, c = nodes.support_nodes[k], nodes.support_components[k]
        stiffness = nodes.stiffness[i]
        support[i, c] = stiffness * u[3 * (i - first) + c] - shared.load[k] - contact[i, c]
    ahead, here = shared.half[first:last].reshape(-1), shared.speeds[: len(u)]
    kick(u, alpha, shared.h, ahead)
    centre(u, eta, ahead, here)
    add_powers(f[first - start : last - start].reshape(-1), here, lanes[INTERNAL])
    add_sparse_forces(begin, end, nodes.support_nodes, nodes.support_components, support, lanes[REACTIONS])
    if len(nodes.external) > 0:
        add_loads(nodes.external[first:last].reshape(-1), here, lanes)
    if damped:
        add_drags(nodes.damping[first:last], here, shared.drag, lanes)


@borrowing
def pass_block(block, counts, rows, alone, nodes, shared, arrays):
    """Solve a block and the rows of its nodes whose other node is in it or in a block before; finish all blocks that
    wait for no other rows.

    ``alone`` (blocks,) bool: whether forces alone determine the increments of a block; ``counts``: numbers of blocks
    that are finished, and of rows that have a force; ``arrays``: internal forces, increments, contact forces (n, 3).
    Returns both numbers, and that of rows whose force begins or ends.
    """
    finished, pressing = counts
    f, u, contact = arrays
    n = len(shared.half)
    if not alone[block]:
        first = NODE_BLOCK * block
        last = min(first + NODE_BLOCK, n)
        solve_block(block, nodes, shared, f, 0, shared.speeds[: 3 * (last - first)], u[first:last].reshape(-1))
    count, changed = solve_rows(block, rows, nodes, shared, u, contact)
    pressing += count
    while finished < len(rows.ready) and rows.ready[finished] <= block:
        if alone[finished]:
            advance_block(finished, nodes, shared, f, 0)
        else:
            first = NODE_BLOCK * finished
            last = min(first + NODE_BLOCK, n)
            finish_block(finished, nodes, shared, f, 0, contact, u[first:last].reshape(-1))
            if pressing > 0:
                _add_pushes(finished, rows, contact, shared.speeds, shared.lanes[CONTACT])
        finished += 1
    return finished, pressing, changed


@borrowing
def _add_pushes(block, rows, contact, speeds, sums):
    """Add the powers of the rows' forces on the nodes of a block with velocities ``speeds`` (3 m,) to ``sums``."""
    first = NODE_BLOCK * block
    for k in range(rows.node_starts[block], rows.node_starts[block + 1]):
        if rows.force[rows.of[k]] > 0.0:
            i = rows.nodes[k]
            at, place = 3 * (i % LANES), 3 * (i - first)
            for c in range(3):
                sums[at + c] += contact[i, c] * speeds[place + c]


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
def finish_rows(rows, changed, slack, nodes, moved, shared, state, u):
    """Return the dissipation [J] of rows that close; ``changed`` rows have a force that begins or ends.

    Velocities and accelerations of the state are written at their nodes; ``moved``: MovingSupports and the step.
    """
    x, half, alpha, eta = shared.x, shared.half, shared.alpha, shared.eta
    v, a, contact = state.v, state.a, state.contact
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


class Pressed(NamedTuple):
    """Results of :func:`~pfem_petsc.contact.explicit.press_nodes` for all blocks of a step: room for ``nodes`` (n,),
    the planes that they are ``touching`` (n, w), their ``places`` (n, 3); ``offsets`` (w,) of the infeasible node; and
    the sums of each wall, ``force`` (w, 3), ``contacts`` (w,) and ``moment`` (w, 3)."""

    nodes: np.ndarray
    touching: np.ndarray
    places: np.ndarray
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
    return Pressed(nodes, touching, places, np.empty(w), force, contacts, moment)


@kernel
def mark_blocks(marks, nodes, value):
    """Set ``marks`` of the blocks of ``nodes`` to ``value``."""
    for i in nodes:
        marks[i // NODE_BLOCK] = value


@borrowing
def find_pressed(block, walls, free, returning):
    """Write the nodes of a block that lie beyond a plane at ``free`` (3 m,), or rebound if any are ``returning``, to
    the walls' room; return their number."""
    first = NODE_BLOCK * block
    return find_beyond(first, free, walls.flat, walls.flat.room, returning)


@kernel
def place_walls(step, walls, level):
    """Set the planes that walls reach one step after a step of the batch, and ``level`` (w,), their offsets at its
    end."""
    flat, motions, normals = walls.flat, walls.motions, walls.flat.normals
    for k in range(len(level)):
        level[k] = flat.offsets[k] = walls.origins[k]
        for c in range(3):
            before, after = motions[step + 1, 0, k, c], motions[step + 2, 0, k, c]
            level[k] += normals[k, c] * before
            flat.offsets[k] += normals[k, c] * after
            flat.way[k, c] = after - before


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
def press_block(block, counts, nodes, walls, shared, places_of, out):
    """Press the nodes of a block that :func:`find_pressed` has found, and append them to those of before; ``counts``:
    their numbers. Return the first node among all of them that is infeasible or, if there is none, jammed, or -1;
    whether it is jammed; and the energy that friction dissipates [J].

    ``places_of``: positions and increments of the nodes of the block, flat, of which the latter are corrected; ``out``:
    contact forces (n, 3) [N], and Pressed, to which they are written.
    """
    m, count = counts
    free, u = places_of
    contact, pressed = out
    first = NODE_BLOCK * block
    found = walls.flat.room[:m].copy()
    places, given = np.empty((m, 3)), Arrivals(np.empty((m, 3)), np.empty((m, 3)), np.empty(m))
    for j in range(m):
        i = found[j]
        given.stiffness[j] = nodes.stiffness[i]
        for c in range(3):
            places[j, c] = free[3 * (i - first) + c]
            given.start[j, c], given.drift[j, c] = shared.x[i, c], shared.h * shared.half[i, c]
    infeasible, jammed, offsets, total, touching, rubbed = press_nodes(found, places, given, walls.flat, pressed)
    for j in range(m):
        i = found[j]
        for c in range(3):
            at = 3 * (i - first) + c
            u[at] += places[j, c] - free[at]
            contact[i, c] = total[j, c]
            pressed.places[count + j, c] = places[j, c]
        pressed.nodes[count + j] = i
        for k in range(touching.shape[1]):
            pressed.touching[count + j, k] = touching[j, k]
    if infeasible >= 0:
        pressed.offsets[:] = offsets[infeasible]
        return count + infeasible, False, rubbed
    return count + jammed if jammed >= 0 else -1, jammed >= 0, rubbed


@kernel
def stop_at_walls(nodes, walls, level, moved, shared, state, u, touched, met):
    """Return the dissipation of contacts that close [J], and the nodes that are on walls afterwards.

    Velocities and accelerations of the state are written at the nodes that touch walls or have touched them; ``level``
    (w,): offsets of the planes; ``moved``: MovingSupports and the step.
    """
    x, half, alpha, eta = shared.x, shared.half, shared.alpha, shared.eta
    v, a, contact = state.v, state.a, state.contact
    around = join_nodes(met, touched, walls.present)
    for i in around:
        centre(u[i], eta, half[i], v[i])
        accelerations(u[i], alpha, a[i])
    all_normals, gaps = plane_gaps(around, x, walls.flat.normals, level)
    free_v, free_a = unpressed(around, v, a, contact, nodes, alpha, eta)
    put_rates(*moved, nodes, v, a)
    for j in range(len(around)):
        i = around[j]
        for c in range(3):
            if walls.touched.fixed[i, c]:  # wall forces do not change prescribed components
                free_v[j, c], free_a[j, c] = v[i, c], a[i, c]
    still = np.zeros(walls.flat.normals.shape)
    rates = walls.motions[moved[1] + 1, 1] if len(walls.motions) > 0 else still
    approach = Approach(all_normals, gaps, free_v, free_a, rates, still)
    counted = np.ones(len(walls.flat.offsets), dtype=np.bool_)
    return stop_nodes(around, approach, walls.touched, nodes.mass, counted, np.empty(gaps.shape))


@kernel
def push_particles(totals, force, links, alpha, h, impulses, u):
    """Advance the particles of the impulses by a step; ``totals`` (3, 3), ``force`` of walls (walls, 3) and ``links``
    (tables, 3) [N]; their increments are written to ``u`` (rows, 3)."""
    first = WALLS + len(force)
    for k in range(len(u)):
        for c in range(3):
            if k < WALLS:
                load = totals[k, c]
            elif k < first:
                load = force[k - WALLS, c]
            else:  # the last rows are those of jumps, which need Python
                load = links[k - first, c] if k < first + len(links) else 0.0
            u[k, c] = load / alpha
    kick(u.reshape(-1), alpha, h, impulses.half.reshape(-1))


@borrowing
def end_block(block, alone, keep, nodes, shared, state, forces):
    """Add what the ledger needs of the end of a step at the nodes of a block to the sums. ``forces`` (m, 3) are those
    of the block, and ``alone`` if they determine the increments. To ``keep`` means to write increments, velocities and
    accelerations to the state; the former remain in ``shared.ends``."""
    h, eta, alpha, ends, lanes = shared.h, shared.eta, shared.alpha, shared.ends, shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    wide = 3 * (last - first)
    u, left, force = ends.u[:wide], ends.left[:wide], forces.reshape(-1)
    if alone:
        spread(shared.inverses[first:last], u)
        if len(nodes.external) > 0:
            load = nodes.external[first:last].reshape(-1)
            for j in range(wide):
                u[j] *= load[j] - force[j]
        else:
            for j in range(wide):
                u[j] *= -force[j]
        for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
            u[3 * (nodes.support_nodes[k] - first) + nodes.support_components[k]] = shared.held[k]
    else:
        copy(state.u[first:last].reshape(-1), u)
    x, half = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    add_ends(x, nodes.mass[first:last], half, force, (h, alpha, eta), ends, lanes)
    if len(nodes.external) > 0:
        add_powers(nodes.external[first:last].reshape(-1), left, lanes[ENDS + EXTERNAL])
    if len(nodes.damping) > 0:
        drag = shared.drag[:wide]
        spread(nodes.damping[first:last], drag)
        for j in range(wide):
            drag[j] *= half[j] - eta * u[j]
        add_powers(drag, left, lanes[ENDS + DAMPING])
    if keep:
        copy(u, state.u[first:last].reshape(-1))
        centre(u, eta, half, state.v[first:last].reshape(-1))
        accelerations(u, alpha, state.a[first:last].reshape(-1))


@borrowing
def end_rows(block, shared, contact):
    """Add the works of the forces of rows over the half step at the nodes of a block, after :func:`end_block`."""
    first = NODE_BLOCK * block
    forces = contact[first : min(first + NODE_BLOCK, len(shared.half))].reshape(-1)
    add_powers(forces, shared.ends.left[: len(forces)], shared.lanes[ENDS + CONTACT])


@borrowing
def end_at_walls(near, shared, contact, u):
    """Add the works of the forces of walls over the half step at the nodes that are ``near``."""
    h, alpha, eta, half, works = shared.h, shared.alpha, shared.eta, shared.half, shared.lanes[ENDS + CONTACT]
    for i in near:
        at = 3 * (i % LANES)
        for c in range(3):
            speed = half[i, c] - eta * u[i, c]
            works[at + c] += contact[i, c] * ((0.5 * h) * (speed - (0.5 * h) * (alpha * u[i, c])))


@kernel
def record_sums(row, ledger, powers, ends, totals, particles, energies):
    """Write the sums of a step to this rank's share of its row: those of the ``ledger`` before it; the works of all
    ``powers`` before its balance, with those of the half step before its end, and kinetic energy and momenta, ``ends``
    of :func:`~pfem_petsc.stepping.ledger_loops.sum_ends`; ``totals`` (3, 3) of its balance; impulses of ``particles``
    (rows, 3) [N s]; ``energies`` of the bars [J]."""
    works, momenta = ends
    for k in range(len(ledger)):
        row[k] = ledger[k]
    stored = 0.0
    for k in range(len(energies)):
        row[_BARS[k]] = energies[k]
        stored += energies[k]
    row[_KINETIC] = works[len(WORKS)]
    row[_EXTERNAL] = powers[EXTERNAL] + works[EXTERNAL]
    row[_DAMPING] = powers[DAMPING] + works[DAMPING]
    inertial = ((powers[INTERNAL] + works[INTERNAL]) - stored) + powers[INERTIAL] - works[INERTIAL]
    pushed = powers[CONTACT] + works[CONTACT] - ledger[_PUSHED] + ledger[_RUBBED]
    row[_NUMERICAL] = inertial - pushed - ledger[_IMPACT]
    for c in range(3):
        for k in range(3):
            row[_MOMENTA + 3 * k + c] = momenta[k, c]
        row[_SUPPORT + c] = totals[0, c]
        for k in range(3):
            row[_IMPULSES + 3 * k + c] = particles[IN_COLUMNS[k], c]


@kernel
def record_contact(row, pressed, walls, rows, particles):
    """Write sums of walls, tables and impulses (rows, 3) to this rank's share of a row."""
    w, t = len(pressed.contacts), len(rows.totals)
    at, jumps = _CHANGES + (1 if w > 0 else 0), WALLS + w + t
    for k in range(w):
        for c in range(3):
            row[at + _WALL_FORCE + c] = pressed.force[k, c]
            row[at + _WALL_MOMENT + c] = pressed.moment[k, c]
            row[at + _WALL_IMPULSE + c] = particles[WALLS + k, c]
            row[at + _WALL_JUMP + c] = particles[jumps + k, c]
        row[at + _CONTACTS], row[at + _RELEASES] = pressed.contacts[k], walls.releases[k]
        at += _WALL
    for k in range(t):
        for c in range(3):
            row[at + _PAIR_FORCE + c] = rows.totals[k, c]
            row[at + _PAIR_IMPULSE + c] = particles[WALLS + w + k, c]
            row[at + _PAIR_JUMP + c] = particles[jumps + w + k, c]
        at += _PAIR


@kernel
def probe_forces(probes, support, contact, pressing, values):
    """Write the forces of supports and contact at the probes."""
    for k in range(len(probes.nodes)):
        i, at = probes.nodes[k], probes.order[k]
        for c in range(3):
            values[at, 3, c] = support[i, c] + contact[i, c] if pressing > 0 else support[i, c]


@borrowing
def probe_block(block, probes, shared, values):
    """Write positions, velocities and accelerations of the probes in a block to ``values`` (p, 4, 3), after
    :func:`end_block`."""
    first, u = NODE_BLOCK * block, shared.ends.u
    for k in range(probes.starts[block], probes.starts[block + 1]):
        i, at = probes.nodes[k], probes.order[k]
        for c in range(3):
            step = u[3 * (i - first) + c]
            values[at, 0, c] = shared.x[i, c]
            values[at, 1, c], values[at, 2, c] = shared.half[i, c] - shared.eta * step, shared.alpha * step


_INT, _SHORT, _BYTES = ir.IntType(64), ir.IntType(32), ir.IntType(8).as_pointer()


def _call(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Generate a call of the function at an address with the number of requests and pointers to arrays."""
    address, count, *arrays = values
    pointers = [
        context.make_array(kind)(context, builder, array).data
        for kind, array in zip(signature.args[2:], arrays, strict=True)
    ]
    kind = ir.FunctionType(_SHORT, [_SHORT] + [_BYTES] * len(pointers))
    function = builder.inttoptr(address, kind.as_pointer())
    arguments = [builder.trunc(count, _SHORT), *(builder.bitcast(pointer, _BYTES) for pointer in pointers)]
    return builder.call(function, arguments)


@intrinsic
def _start_all(typingctx, address, count, requests):  # noqa: ANN001, ANN201
    """Call ``MPI_Startall`` at an address; return its error code."""
    return types.int32(types.int64, types.int64, requests), _call


@intrinsic
def _wait_all(typingctx, address, count, requests, statuses):  # noqa: ANN001, ANN201
    """Call ``MPI_Waitall`` at an address; return its error code."""
    return types.int32(types.int64, types.int64, requests, statuses), _call


@kernel
def start_positions(messages, x, h, half):
    """Send the positions that owned nodes reach in a step, x + h ``half`` (owned, 3); return MPI's error code.

    ``messages``: a :class:`~pfem_petsc.mesh.exchange.Messages`.
    """
    rows, leaving = messages.rows, messages.leaving
    for k in range(len(rows)):
        i = rows[k]
        for c in range(3):
            leaving[k, c] = x[i, c] + h * half[i, c]
    return _start_all(messages.start_all, messages.count, messages.requests)


@kernel
def finish_positions(messages, x, before, fill):
    """Wait for the messages of :func:`start_positions`; if ``fill``, update the ghosts in ``x`` (local, 3), with their
    previous positions in ``before``. Return MPI's error code."""
    arriving = messages.arriving
    failed = _wait_all(messages.wait_all, messages.count, messages.requests, messages.statuses)
    first = len(x) - len(arriving)
    for k in range(len(arriving) if fill else 0):
        for c in range(3):
            before[first + k, c] = x[first + k, c]
            x[first + k, c] = arriving[k, c]
    return failed


_pull = calls(PULLED)


@borrowing
def pull(x, bars, block, f, work):
    """Add the forces of the bars of a block of nodes, or, after the last one, of those that other ranks count; results
    as those of :data:`~pfem_petsc.mechanics.elements.PULLED`."""
    failed, shortened, broke = -1, False, 0
    for s in range(len(bars.sections)):
        begun, ended = bars.parts[s, block], bars.parts[s, block + 1]
        if begun < ended:
            address, loop = bars.sections[s, 0], bars.sections[s, 1]
            at, short, more = _pull(loop, (x, address, begun, ended, f, work[s]))
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
    return failed, shortened, broke


@borrowing
def pull_padded(x, bars, base, block, work, counts):
    """Add the same forces by padded runs to ``bars.pulls``, and energies to ``work`` if it ``counts`` them; ``base`` is
    the first node there."""
    failed, shortened, broke = -1, False, 0
    for s in range(len(bars.sections)):
        begun, ended = bars.padded_parts[s, block], bars.padded_parts[s, block + 1]
        if begun < ended:
            address, loop = bars.sections[s, 0], bars.sections[s, 2]
            at, short, more = _pull(loop, (x, address, np.int64(base), begun, ended, work[s], counts))
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
    return failed, shortened, broke


@borrowing
def pull_again(x, n_blocks, bars, springs, f, work, sums):
    """Compute all forces in the order of a step; ``sums`` (4,) of springs are overwritten."""
    flat = f.reshape(-1)
    for j in range(len(flat)):
        flat[j] = 0.0
    pull(x, bars, n_blocks, f, work)
    for block in range(n_blocks):
        pull(x, bars, block, f, work)
    add_springs(0, len(springs.nodes), springs, x, f, 0, sums)


@kernel
def new_work(sections, rows):
    """Return workspaces of some rows for each section, aligned; not initialised."""
    return new_rows(sections * rows)[: sections * rows * ROW].reshape(sections, rows * ROW)


@borrowing
def clear_all_energies(bars, work):
    """Set the sums of energies of all sections to zero."""
    for s in range(len(bars.sections)):
        clear_energies(work[s], bars.places[s, : bars.n_energies[s]])


@borrowing
def sum_all_energies(bars, work, energies):
    """Write the energies of the bars of all sections."""
    energies[:] = 0.0
    for s in range(len(bars.sections)):
        sum_energies(work[s], bars.places[s, : bars.n_energies[s]], energies)


@kernel
def batch_loop(data, touched, met, due, flags):
    """Make a batch of steps, with bars of any law.

    Its arguments are BatchData; nodes (m,) that touch walls; nodes (k,) that have touched walls and not left them;
    ``due`` (count,) bool, the steps with a row; and ``flags`` (count, walls) bool, which receives the walls that are
    touched in each step. Velocities, accelerations and increments are written to the state in the last step alone. It
    returns Made: fewer steps on one rank where something fails or bars change their state of rupture; several ranks
    make all steps, as others wait for their messages.
    """
    count, h, x, before, half = len(flags), data.h, data.x, data.before, data.half
    bars, nodes, walls, rows, messages, state = (
        data.bars,
        data.nodes,
        data.walls,
        data.rows,
        data.messages,
        data.state,
    )
    springs, moving = data.springs, data.moving
    sprung, carried = len(springs.nodes) > 0, len(moving.at) > 0
    grounds, jumps = np.zeros(4), np.zeros((2, 3))
    ledger, powers, impulses, probes, shares = data.ledger, data.powers, data.impulses, data.probes, data.shares
    n = len(half)
    n_walls = len(walls.flat.offsets)
    f, a, v, support, contact, u = state.f, state.a, state.v, state.support, state.contact, state.u
    alpha = 1.0 / (h * h)
    eta = 0.5 / h
    supported, loaded = len(nodes.support_nodes) > 0, len(nodes.external) > 0
    damped = len(nodes.damping) > 0
    linked = len(rows.ready) > 0
    plain = n_walls == 0 and not damped and not linked  # forces alone determine increments
    increments, factors = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK)
    load, held = np.empty(len(nodes.support_nodes)), np.empty(len(nodes.support_nodes))
    speeds, drag = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK if damped else 0)
    ends = EndArrays(np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK), np.empty(WIDE), np.empty(WIDE))
    totals, lanes, after = np.zeros((3, 3)), new_sums(), np.empty(len(WORKS))
    sums, energies = (np.empty(len(WORKS) + 1), np.empty((3, 3))), np.empty(len(_BARS))
    probed = len(probes.nodes)
    numbers, buffers = (h, alpha, eta), (factors, speeds, drag)
    shared = BlockArrays(*numbers, x, half, nodes.inverses, *buffers, held, load, support, lanes, ends)
    work = new_work(len(bars.sections), bars.work_rows)
    pulled = np.empty((NODE_BLOCK, 3))  # forces of a block
    push_u = np.empty(impulses.v.shape)
    near = touched  # nodes with entries in the array of wall forces
    pressed = new_pressed(n, n_walls)
    n_blocks = (n + NODE_BLOCK - 1) // NODE_BLOCK
    # blocks whose forces alone determine their increments; blocks with nodes that touch walls or have touched them
    alone, on_walls = np.ones(n_blocks, dtype=np.bool_), np.zeros(n_blocks, dtype=np.bool_)
    along = np.zeros(n_blocks, dtype=np.bool_)  # blocks with supports that move
    for p in range(len(moving.at)):
        along[nodes.support_nodes[moving.at[p]] // NODE_BLOCK] = True
    for block in range(n_blocks if linked else 0):
        alone[block] = not (damped or rows.near[block] or along[block])
    # fields that loops over blocks would count references to
    planes, pulls = bars.planes, bars.pulls
    room_for, reach = len(planes) // 3, bars.reach
    failed = -1
    turned = -1
    infeasible = -1
    changed = 0
    touching = 0
    done = 0
    recorded = 0
    changes, friction = data.changes, data.friction
    travels, bounces, jammed = len(walls.motions) > 0, len(walls.flat.restitution) > 0, False
    level = walls.flat.offsets.copy()  # of planes at the end of the step
    several = len(x) > n or messages.count > 0
    lost = 0  # error code of MPI
    aside = new_work(len(bars.sections), bars.work_rows)  # energies that are not counted
    padded = bars.padded_parts.shape[1] > 0
    shortened = False
    for step in range(count):
        if failed >= 0 or turned >= 0 or infeasible >= 0:
            # the other ranks still need messages, until all know of the failure
            lost = start_positions(messages, x, h, half)
            lost = finish_positions(messages, x, before, False) if lost == 0 else lost
            if lost != 0:
                break
            continue
        last_one, row = step == count - 1, shares[recorded]
        ending = due[step] or last_one
        values = row[len(row) - 3 * _PROBED * probed :].reshape(probed, _PROBED, 3)
        for i in near:
            contact[i] = 0.0
        place_supports(moving, step, nodes)
        if travels:
            place_walls(step, walls, level)
        ledger[_RUBBED] += friction  # on the way that the balance before has determined
        friction = 0.0
        grounds[:] = 0.0
        if len(data.loads.gravity) > 0:
            set_forces(step, data.loads, nodes.mass, nodes.external)
        clear_forces(lanes, n, Acting(supported, loaded, False, damped))
        if ending:
            clear_ends(lanes, n)
        changed = 0
        moved = 0
        base = 0  # first node of the planes
        # Forces that nothing reads stay in the cache. The check of shortened bars reads them, as the next one is
        # likely to; those of laws with history could not be computed again. Blocks that wait for rows need them.
        brief = padded and not last_one and not shortened and not bars.keeps and not linked
        forces = pulled if brief else f
        shortened = False
        if several:
            lost = start_positions(messages, x, h, half)
            if lost != 0:
                break
        waiting = several
        if ending or not padded:
            clear_all_energies(bars, work)
        count_near = 0
        finished, pressing, altered = 0, 0, 0  # blocks; rows with a force, and rows whose force begins or ends
        if linked:
            clear_sums(lanes[CONTACT], n)
        if n_walls > 0:
            pressed.force[:], pressed.contacts[:], pressed.moment[:] = 0.0, 0, 0.0
            mark_blocks(on_walls, touched, True)
            mark_blocks(on_walls, met, True)
        # Blocks of nodes pass once through the cache: each moves shortly before its first bar, and is finished
        # after its last one, which belongs to its own block or to one before. Messages are on their way until the
        # first block that needs ghosts.
        for block in range(n_blocks + 1):
            if waiting and block == min(bars.meeting, n_blocks):
                while moved < n_blocks:
                    move_block(moved, shared, f, padded, bars, base)
                    moved += 1
                for i in range(n, len(x)):
                    f[i, 0] = f[i, 1] = f[i, 2] = 0.0
                lost = finish_positions(messages, x, before, True)
                if lost != 0:
                    break
                if padded:
                    split_block(n, len(x), x, planes, pulls, base)
                    at, short, broke = pull_padded(x, bars, base, n_blocks, aside, False)
                else:
                    at, short, broke = pull(x, bars, n_blocks, f, aside)
                failed = at if at >= 0 else failed
                shortened = shortened or short
                changed += broke
                waiting = False
            if block == n_blocks:
                break
            while moved < min(block + 1 + reach, n_blocks):
                if padded and not several and room_for < NODE_BLOCK * (moved + 1) - base:
                    live = NODE_BLOCK * block
                    slide_planes(planes, live - base, NODE_BLOCK * moved - live)
                    slide_planes(pulls, live - base, NODE_BLOCK * moved - live)
                    base = live
                move_block(moved, shared, f, padded, bars, base)
                moved += 1
            start = NODE_BLOCK * block if brief else 0
            if padded:
                at, short, broke = pull_padded(x, bars, base, block, work, ending)
                join_block(block, n, pulls, base, forces, start)
            else:
                at, short, broke = pull(x, bars, block, f, work)
            failed = at if failed < 0 else failed
            shortened = shortened or short
            changed += broke
            first, last = NODE_BLOCK * block, min(NODE_BLOCK * (block + 1), n)
            if sprung:
                add_springs(springs.starts[block], springs.starts[block + 1], springs, x, forces, start, grounds)
            if linked:
                ready = finished
                finished, pressing, more = pass_block(
                    block, (finished, pressing), rows, alone, nodes, shared, (f, u, contact)
                )
                altered += more
                for over in range(ready, finished if ending else ready):
                    end = min(NODE_BLOCK * (over + 1), n)
                    end_block(over, alone[over], last_one, nodes, shared, state, f[NODE_BLOCK * over : end])
                    probe_block(over, probes, shared, values)
                    if pressing > 0:
                        end_rows(over, shared, contact)
                continue
            if plain and not along[block]:
                advance_block(block, nodes, shared, forces, start)
            else:
                free, here = speeds[: 3 * (last - first)], increments[: 3 * (last - first)]
                solve_block(block, nodes, shared, forces, start, free, here)
                found = 0
                if n_walls > 0:
                    found = find_pressed(block, walls, free, bounces and on_walls[block])
                if found > 0:
                    counts, out = (found, count_near), (contact, pressed)
                    at, jam, rubbed = press_block(block, counts, nodes, walls, shared, (free, here), out)
                    if at >= 0 and (infeasible < 0 or (jammed and not jam)):
                        infeasible, jammed = at, jam
                    friction += rubbed
                    count_near += found
                finish_block(block, nodes, shared, forces, start, contact, here)
                alone[block] = not (damped or on_walls[block] or found > 0)
                if not alone[block]:
                    copy(here, u[first:last].reshape(-1))
            if ending:
                end_block(block, alone[block], last_one, nodes, shared, state, forces[first - start : last - start])
                probe_block(block, probes, shared, values)
        if n_walls > 0:
            mark_blocks(on_walls, touched, False)
            mark_blocks(on_walls, met, False)
            near = pressed.nodes[:count_near]
            if count_near > 0 or len(touched) > 0:
                more, touched = compare_contacts(
                    walls.touched.touching, touched, near, pressed.touching, walls.present, walls.releases
                )
                changes += more
        if lost != 0:
            break
        impact = 0.0
        if len(near) > 0:
            for i in near:
                centre(u[i], eta, half[i], v[i])
            clear_sums(lanes[CONTACT], n)
            add_sparse_powers(near, contact, v, lanes[CONTACT])
        if len(touched) > 0 or len(met) > 0:
            impact, met = stop_at_walls(nodes, walls, level, (moving, step), shared, state, u, touched, met)
        if altered > 0:
            impact += finish_rows(rows, altered, walls.touched.slack, nodes, (moving, step), shared, state, u)
        sum_rows(rows, pressing)
        touching = len(near) + 2 * pressing
        after[:] = powers
        sum_balance(lanes, n, h, Acting(supported, loaded, touching > 0, damped), totals, after)
        for c in range(3 if sprung else 0):
            totals[0, c] -= grounds[c]
        if carried:
            add_inertia(moving, step, nodes, shared, (totals, after, jumps))
        push_particles(totals, pressed.force, rows.totals, alpha, h, impulses, push_u)
        ledger[_IMPACT] += impact
        if travels:
            ledger[_PUSHED] += work_of_walls(step, walls, data.push, pressed.force)
        for k in range(n_walls):
            flags[step, k] = pressed.contacts[k] > 0
        done += 1
        wrong = failed >= 0 or infeasible >= 0 or changed > 0 or not np.isfinite(after[INTERNAL])
        if shortened or wrong or last_one:
            turned = -1
            if brief:
                pull_again(x, n_blocks, bars, springs, f, aside, np.empty(4))
            if not last_one:  # the state does not have the end of this step yet
                clear_ends(lanes, n)
                for block in range(n_blocks):
                    first, last = NODE_BLOCK * block, min(NODE_BLOCK * (block + 1), n)
                    end_block(block, alone[block], True, nodes, shared, state, f[first:last])
                    probe_block(block, probes, shared, values)
                    if pressing > 0:
                        end_rows(block, shared, contact)
            start_of_step(x[:n].reshape(-1), h, v.reshape(-1), a.reshape(-1), before[:n].reshape(-1))
            if failed < 0 and shortened:
                turned = first_inverted(x, before, bars.ends, bars.watched)
            wrong = wrong or turned >= 0
            put_rates(moving, step, nodes, v, a)
        if ending or wrong:
            if padded and not ending:
                clear_all_energies(bars, work)  # a failure, whose energies nothing reads
            end_at_walls(near, shared, contact, u)
            sum_ends(lanes, n, h, *sums)
            sum_all_energies(bars, work, energies)
            if sprung:
                energies[bars.spring_place] = grounds[3]
            centre(push_u.reshape(-1), eta, impulses.half.reshape(-1), impulses.v.reshape(-1))
            accelerations(push_u.reshape(-1), alpha, impulses.a.reshape(-1))
            if carried:
                add_ends_of_supports(moving, step, nodes, shared, sums, values)
                for c in range(3):
                    impulses.v[SUPPORT, c] += jumps[1, c]
            record_sums(row, ledger, powers, sums, totals, impulses.v, energies)
            row[_PRESSING] = touching
            record_contact(row, pressed, walls, rows, impulses.v)
            probe_forces(probes, support, contact, touching, values)
            if n_walls > 0:
                row[_CHANGES] = changes
            if due[step]:
                changes = 0
            recorded += 1
        for c in range(3 if carried else 0):
            impulses.half[SUPPORT, c] += jumps[0, c]
        powers[:] = after
        if wrong and not several:
            break
    return Made(
        done,
        recorded,
        lost,
        changed,
        failed,
        turned,
        infeasible,
        jammed,
        pressed.offsets,
        pressed.force,
        pressed.contacts,
        pressed.moment,
        near.copy(),
        pressed.touching[: len(near)].copy(),
        pressed.places[: len(near)].copy(),
        touched,
        met,
        touching,
        changes,
        friction,
    )
