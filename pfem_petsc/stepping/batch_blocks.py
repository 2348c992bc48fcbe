"""The passes of a batch of steps over blocks of nodes: move, solve, walls, rows between nodes, history rows, ghosts."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from ..columns import HEAD
from ..contact.explicit import find_beyond, press_nodes
from ..contact.fixed_rows import close_rows, solve_rows
from ..contact.impact import Approach, join_nodes, plane_gaps, stop_nodes, unpressed
from ..integrators._leapfrog import advance, advance_loaded, centre, kick, move
from ..mechanics.compiled import borrowing, kernel
from ..mechanics.runs import join_components, split_components
from ..mesh.ordering import NODE_BLOCK
from .explicit import accelerations, explicit_increments, hold_still
from .impulses import WALLS, fill_impulses
from .ledger_loops import (
    CONTACT,
    INTERNAL,
    LANES,
    REACTIONS,
    NodeValues,
    RowRoom,
    add_drags,
    add_loads,
    add_powers,
    add_sparse_forces,
    add_totals,
    book_row,
    fill_bars,
    fill_links,
    fill_probes,
    fill_walls,
    fill_works,
    spread,
)


@borrowing
def move_block(block, shared, f, light, bars, base):
    """Move the nodes of a block, and set their forces to zero; in ``light`` steps those of :func:`split_block`."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where = shared.x[first:last].reshape(-1)
    move(where, shared.h, shared.half[first:last].reshape(-1))
    if light:
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
        advance_loaded(force, load, factor, alpha, eta, h, ahead, here, lanes[INTERNAL])
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
    h, alpha, eta = shared.h, shared.alpha, shared.eta
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
        shared.load[k] = (alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)) * u[j]
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
        stiffness = alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)
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
def finish_rows(rows, changed, slack, nodes, shared, state, u):
    """Return the dissipation [J] of rows that close; ``changed`` rows have a force that begins or ends.

    Velocities and accelerations of the state are written at their nodes.
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
def find_pressed(block, walls, free):
    """Write the nodes of a block that lie beyond a plane at ``free`` (3 m,) to ``walls.room``; return their number."""
    first = NODE_BLOCK * block
    return find_beyond(first, free, walls, walls.room)


@kernel
def press_block(block, counts, nodes, walls, shared, places_of, out):
    """Press the nodes of a block that :func:`find_pressed` has found, and append them to those of before; ``counts``:
    their numbers. Return the first infeasible node among all of them, or -1.

    ``places_of``: positions and increments of the nodes of the block, flat, of which the latter are corrected; ``out``:
    contact forces (n, 3) [N], and Pressed, to which they are written.
    """
    m, count = counts
    alpha, eta = shared.alpha, shared.eta
    free, u = places_of
    contact, pressed = out
    first = NODE_BLOCK * block
    damped = len(nodes.damping) > 0
    found = walls.room[:m].copy()
    places, stiffness = np.empty((m, 3)), np.empty(m)
    for j in range(m):
        i = found[j]
        stiffness[j] = alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)
        for c in range(3):
            places[j, c] = free[3 * (i - first) + c]
    infeasible, offsets, total, touching = press_nodes(found, places, walls, stiffness, pressed)
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
        infeasible += count
    return infeasible


_HEAD, _KINETIC = HEAD.width, HEAD.first("kinetic_energy")  # constants of the machine code
_CONTACTS, _SLACK = HEAD.first("active_contacts"), HEAD.first("slack_bars")


@kernel
def stop_at_walls(nodes, walls, shared, state, u, touched, met):
    """Return the dissipation of contacts that close [J], and the nodes that are on walls afterwards.

    Velocities and accelerations of the state are written at the nodes that touch walls or have touched them.
    """
    x, half, alpha, eta = shared.x, shared.half, shared.alpha, shared.eta
    v, a, contact = state.v, state.a, state.contact
    around = join_nodes(met, touched, walls.present)
    for i in around:
        centre(u[i], eta, half[i], v[i])
        accelerations(u[i], alpha, a[i])
    all_normals, gaps = plane_gaps(around, x, walls.normals, walls.offsets)
    free_v, free_a = unpressed(around, v, a, contact, nodes, alpha, eta)
    for j in range(len(around)):
        i = around[j]
        for c in range(3):
            if walls.fixed[i, c]:  # wall forces do not change prescribed components
                free_v[j, c], free_a[j, c] = v[i, c], a[i, c]
    still = np.zeros(walls.normals.shape)
    approach = Approach(all_normals, gaps, free_v, free_a, still, still)
    counted = np.ones(len(walls.offsets), dtype=np.bool_)
    return stop_nodes(around, approach, walls, nodes.mass, counted, np.empty(gaps.shape))


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
def complete(nodes, shared, state, alone, stiffness, u):
    """Compute the increments of blocks whose forces ``alone`` (blocks,) determine them, and accelerations and
    velocities of all nodes; ``stiffness`` (n,) is workspace."""
    n, f, v, a = len(shared.half), state.f, state.v, state.a
    half, alpha, eta, held = shared.half, shared.alpha, shared.eta, shared.held
    loaded, nothing = len(nodes.external) > 0, np.empty((0, 3))
    for block in range(len(alone)):
        if not alone[block]:
            continue
        first = NODE_BLOCK * block
        last = min(first + NODE_BLOCK, n)
        loads = nodes.external[first:last] if loaded else nothing
        inertia = nodes.mass[first:last], nodes.damping
        explicit_increments(
            (loads, f[first:last]), inertia, (alpha, eta), (nothing, nothing), stiffness[first:last], u[first:last]
        )
        for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
            u[nodes.support_nodes[k], nodes.support_components[k]] = held[k]
    centre(u.reshape(-1), eta, half.reshape(-1), v.reshape(-1))
    accelerations(u.reshape(-1), alpha, a.reshape(-1))


class RowSums(NamedTuple):
    """What a row has besides the state: increments of the particles, see :func:`push_particles`; forces (w, 3),
    moments, contacts and releases of the walls; forces of the tables of links; number of nodes with contact forces;
    totals (6, 3) of the balance; and workspace."""

    increments: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    contacts: np.ndarray
    releases: np.ndarray
    links: np.ndarray
    touching: int
    totals: np.ndarray
    room: RowRoom
    ends: np.ndarray


@kernel
def fill_row(data, sums, row):
    """Fill the ledger's sums and the row of a step whose state is complete; return the kinetic energy [J].

    ``data``: :class:`~pfem_petsc.stepping.batch_loop.BatchData`; ``sums``: RowSums.
    """
    h, x, bars, nodes, probes, state = data.h, data.x, data.bars, data.nodes, data.probes, data.state
    impulses, powers, ledger = data.impulses, data.powers, data.ledger
    push_u, link_sums, touching = sums.increments, sums.links, sums.touching
    totals, room, ends = sums.totals, sums.room, sums.ends
    alpha, eta = 1.0 / (h * h), 0.5 / h
    n, energies = len(state.v), state.energies
    stored = 0.0
    for k in range(len(energies)):
        stored += energies[k]
    none = np.empty((0, 3))
    pushed = state.contact if touching > 0 else none
    reaction = state.support if len(nodes.support_nodes) > 0 else none
    forces = state.f[:n]
    values = NodeValues(x[:n], state.v, state.a, forces, nodes.external, reaction, pushed, nodes.mass, nodes.damping)
    kinetic = book_row(values, h, room, totals, ends)
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
            slack += bars.data.history[bars.slack, k]
        row[_SLACK] = slack
    at = _HEAD
    force, moment, contacts, releases = sums.force, sums.moment, sums.contacts, sums.releases
    if len(force) > 0:
        at = fill_walls(row, _HEAD + 1, force, moment, impulses.v, contacts, releases)
    at = fill_links(row, at, link_sums, impulses.v, WALLS + len(force))
    values = NodeValues(
        x[:n], state.v, state.a, forces, nodes.external, reaction, state.contact, nodes.mass, nodes.damping
    )
    fill_probes(row, at, probes, values)
    return kinetic


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
