"""The loop of a batch: steps of central differences in one compiled call, block of nodes by block of nodes.

A block is moved shortly before its first bar, and finished after its last one, while it is in the cache: the passes
over a block are in ``batch_blocks.py``, ``batch_contact.py`` and ``batch_history.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from ..columns import BAR_ENERGIES, HEAD, PROBED
from ..contact.fixed_rows import pressed_nodes, solve_rows
from ..contact.node_walls import compare_contacts
from ..integrators._leapfrog import accelerations, centre
from ..mechanics.compiled import generate_call, kernel
from ..mechanics.elements import first_inverted
from ..mechanics.loads import LoadSchedule, set_forces
from ..mechanics.runs import copy, slide_planes
from ..mesh.ordering import NODE_BLOCK
from .batch_blocks import (
    BarArrays,
    BlockArrays,
    NodeArrays,
    StateArrays,
    advance_block,
    clear_all_energies,
    finish_block,
    join_block,
    move_block,
    new_work,
    place_block,
    predict,
    pull,
    pull_again,
    pull_padded,
    solve_block,
    split_block,
    sum_all_energies,
)
from .batch_contact import (
    WallArrays,
    find_pressed,
    finish_rows,
    mark_blocks,
    new_pressed,
    place_walls,
    press_block,
    stop_at_walls,
    sum_rows,
    work_of_walls,
)
from .batch_history import (
    ImpulseArrays,
    ProbeArrays,
    end_at_contacts,
    end_block,
    probe_forces,
    push_particles,
    record_contact,
    record_sums,
)
from .batch_rows import CLOSE, FAILED, SOLVE, CalledRows, call_rows
from .batch_supports import (
    MovingSupports,
    SpringArrays,
    add_ends_of_supports,
    add_inertia,
    add_springs,
    place_supports,
    put_rates,
)
from .impact import join_nodes
from .impulses import SUPPORT
from .ledger_loops import (
    CONTACT,
    INTERNAL,
    WORKS,
    Acting,
    EndArrays,
    add_sparse_powers,
    clear_ends,
    clear_forces,
    clear_sums,
    new_sums,
    start_of_step,
    sum_balance,
    sum_ends,
)


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
    called: CalledRows
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

    ``done``: number of steps made; ``passed``: those that other ranks make too, of which this one only sends
    messages after a failure; ``recorded``: number of shares of rows; ``lost``: error code of MPI. In the last step:
    ``changed``: number of bars that changed their state of rupture; ``failed``, ``turned``: the first bar that
    collapsed, and that went through zero length, or -1; ``placeless``: index in ``near`` of a node whose place at
    walls was not found, or -1, and ``why``, see :func:`~pfem_petsc.contact.explicit.press_nodes`, with ``normals`` and
    ``offsets`` of its planes; ``unsolved``: whether a call for rows failed; ``force``, ``contacts``,
    ``moment``: sums of the walls; ``near``: nodes with wall forces, the walls that they are ``touching``, and their
    ``places``; ``touched``, ``met``: nodes that touch walls, and that have touched them and not left; ``pressing``:
    number of nodes with contact forces; ``changes``: contacts that closed or opened since the last row; and
    ``friction``: the energy that it dissipates in the next step [J].
    """

    done: int
    passed: int
    recorded: int
    lost: int
    changed: int
    failed: int
    turned: int
    placeless: int
    why: int
    unsolved: bool
    normals: np.ndarray
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


_PUSHED, _RUBBED, _IMPACT = map(HEAD.first, ("contact_work", "friction_dissipation", "impact_dissipation"))
_ENERGIES, _PROBED = len(BAR_ENERGIES), len(PROBED)


@intrinsic
def _start_all(typingctx, address, count, requests):  # noqa: ANN001, ANN201
    """Call ``MPI_Startall`` at an address; return its error code."""
    return types.int32(types.int64, types.int32, requests), generate_call


@intrinsic
def _wait_all(typingctx, address, count, requests, statuses):  # noqa: ANN001, ANN201
    """Call ``MPI_Waitall`` at an address; return its error code."""
    return types.int32(types.int64, types.int32, requests, statuses), generate_call


@intrinsic
def _reduce_all(typingctx, address, mine, every, count, kind, operation, comm):  # noqa: ANN001, ANN201
    """Call ``MPI_Allreduce`` at an address; return its error code."""
    return types.int32(types.int64, mine, every, types.int32, types.int64, types.int64, types.int64), generate_call


@kernel
def any_rank(messages, here):
    """Return whether a condition holds on any rank, and MPI's error code. Collective."""
    mine, every, handles = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32), messages.handles
    mine[0] = 1 if here else 0
    lost = _reduce_all(messages.reduce_all, mine, every, np.int32(1), handles[0], handles[1], handles[2])
    return every[0] > 0, lost


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


@kernel
def batch_loop(data, touched, met, due, flags):
    """Make a batch of steps, with bars of any law.

    Its arguments are BatchData; nodes (m,) that touch walls; nodes (k,) that have touched walls and not left them;
    ``due`` (count,) bool, the steps with a row; and ``flags`` (count, walls) bool, which receives the walls that are
    touched in each step. Velocities, accelerations and increments are written to the state in the last step alone. It
    returns Made: fewer steps where bars of any rank change their state of rupture, and where something fails, except
    on several ranks that need not agree: these make all steps then, as others wait for their messages.
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
    springs, moving, called = data.springs, data.moving, data.called
    sprung, carried = len(springs.nodes) > 0, len(moving.at) > 0
    grounds, jumps = np.zeros(4), np.zeros((2, 3))
    ledger, powers, impulses, probes, shares = data.ledger, data.powers, data.impulses, data.probes, data.shares
    n = len(half)
    n_walls = len(walls.pressed.way)
    f, a, v, support, contact, u = state.f, state.a, state.v, state.support, state.contact, state.u
    alpha = 1.0 / (h * h)
    eta = 0.5 / h
    supported, loaded = len(nodes.support_nodes) > 0, len(nodes.external) > 0
    damped = len(nodes.damping) > 0
    linked, calling = len(rows.ready) > 0, called.address != 0
    waits = linked or calling  # blocks for rows
    increments, factors = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK)
    load, held = np.empty(len(nodes.support_nodes)), np.empty(len(nodes.support_nodes))
    speeds, drag = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK if damped else 0)
    ends = EndArrays(np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK))
    totals, lanes, after = np.zeros((3, 3)), new_sums(), np.empty(len(WORKS))
    sums, energies = (np.empty(len(WORKS) + 1), np.empty((3, 3))), np.empty(_ENERGIES)
    probed = len(probes.nodes)
    numbers, buffers = (h, alpha, eta), (factors, speeds, drag)
    shared = BlockArrays(*numbers, x, half, nodes.inverses, *buffers, held, load, support, lanes, ends)
    work = new_work(len(bars.sections), bars.work_rows)
    pulled = np.empty((NODE_BLOCK, 3))  # forces of a block
    push_u = np.empty(impulses.v.shape)
    # nodes with entries in the array of contact forces, of walls and of all contacts
    near, others = touched, called.held[: called.counts[0]]
    if linked:
        others = pressed_nodes(rows, np.count_nonzero(rows.force > 0.0))
    held = join_nodes(near, others, walls.present)
    pressed = new_pressed(n, n_walls)
    n_blocks = (n + NODE_BLOCK - 1) // NODE_BLOCK
    # blocks whose forces alone determine their increments, in all steps and in this one; blocks with nodes that touch
    # walls or have touched them
    easy, alone = np.full(n_blocks, n_walls == 0 and not damped and not calling), np.ones(n_blocks, dtype=np.bool_)
    on_walls = np.zeros(n_blocks, dtype=np.bool_)
    for p in range(len(moving.at)):
        easy[nodes.support_nodes[moving.at[p]] // NODE_BLOCK] = False
    for block in range(n_blocks if linked else 0):
        easy[block] = easy[block] and not rows.near[block]
    # fields that loops over blocks would count references to
    planes, pulls = bars.planes, bars.pulls
    room_for, reach = len(planes) // 3, bars.reach
    failed = -1
    turned = -1
    changed = 0
    touching = 0
    done = 0
    passed = 0
    recorded = 0
    changes, friction = data.changes, data.friction
    travels, bounces = len(walls.motions) > 0, len(walls.pressed.restitution) > 0
    several, stops = messages.reduce_all != 0, False
    agree = several and (bars.can_break or calling)  # ranks that make the same steps
    lost = 0  # error code of MPI
    aside = new_work(len(bars.sections), bars.work_rows)  # energies that are not counted
    padded = bars.padded_parts.shape[1] > 0
    shortened = False
    for step in range(count):
        if failed >= 0 or turned >= 0 or pressed.failure[0] >= 0:
            # the other ranks still need messages, until all know of the failure
            lost = start_positions(messages, x, h, half)
            lost = finish_positions(messages, x, before, False) if lost == 0 else lost
            passed += 1
            if lost != 0:
                break
            continue
        last_one, row = step == count - 1, shares[recorded]
        ending = due[step] or last_one
        values = row[len(row) - 3 * _PROBED * probed :].reshape(probed, _PROBED, 3)
        for i in held:
            contact[i] = 0.0
        place_supports(moving, step, nodes)
        if travels:
            place_walls(step, walls)
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
        brief = padded and not last_one and not shortened and not bars.keeps and not waits
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
        unsolved = np.int64(0)  # result of a call
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
            ready = block + 1  # blocks that can be finished
            if block < n_blocks:
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
                if not easy[block]:
                    here = u[first:last].reshape(-1) if waits else increments[: 3 * (last - first)]
                    solve_block(block, nodes, shared, forces, start, speeds[: len(here)], here)
                if linked:
                    some, more = solve_rows(block, rows, nodes, shared, u, contact)
                    pressing += some
                    altered += more
                    ready = finished
                    while ready < n_blocks and rows.ready[ready] <= block:
                        ready += 1
                elif calling:
                    predict(block, shared, called.predictor)
                    ready = 0
            elif calling:
                unsolved = call_rows(called.address, step, SOLVE)
                ready = n_blocks
            for over in range(finished, min(ready, n_blocks)):
                first, last = NODE_BLOCK * over, min(NODE_BLOCK * (over + 1), n)
                start = first if brief else 0
                if easy[over]:
                    advance_block(over, nodes, shared, forces, start)
                else:
                    free, here = speeds[: 3 * (last - first)], increments[: 3 * (last - first)]
                    if waits:
                        here = u[first:last].reshape(-1)
                        place_block(over, shared, here, free)
                    found = 0
                    if n_walls > 0:
                        found = find_pressed(over, walls, free, bounces and on_walls[over])
                    if found > 0:
                        counts, out = (found, count_near), (contact, pressed)
                        friction += press_block(over, counts, nodes, walls, shared, (free, here), out)
                        count_near += found
                    finish_block(over, nodes, shared, forces, start, contact, here)
                    alone[over] = not (waits or damped or on_walls[over] or found > 0)
                    if not (waits or alone[over]):
                        copy(here, u[first:last].reshape(-1))
                if ending:
                    how = alone[over], last_one
                    end_block(over, how, nodes, shared, state, forces[first - start : last - start], (probes, values))
            finished = min(ready, n_blocks)
        if n_walls > 0:
            mark_blocks(on_walls, touched, False)
            mark_blocks(on_walls, met, False)
            near = pressed.nodes[:count_near]
            if count_near > 0 or len(touched) > 0:
                more, touched = compare_contacts(
                    walls.touched.touching, touched, near, pressed.touching, walls.present, walls.releases
                )
                changes += more
        if lost != 0 or unsolved < FAILED:
            break
        impact = 0.0
        held = near
        if waits:
            others = pressed_nodes(rows, pressing) if linked else called.held[: called.counts[0]]
            held = join_nodes(near, others, walls.present)
        if len(held) > 0:
            for i in held:
                centre(u[i], eta, half[i], v[i])
            clear_sums(lanes[CONTACT], n)
            add_sparse_powers(held, contact, v, lanes[CONTACT])
        if len(touched) > 0 or len(met) > 0:
            impact, met = stop_at_walls(nodes, walls, (moving, step), shared, state, (touched, met))
        if altered > 0:
            impact += finish_rows(rows, altered, walls.touched.slack, nodes, (moving, step), shared, state)
        if calling and called.counts[1] > 0:
            for i in called.changing[: called.counts[1]]:
                centre(u[i], eta, half[i], v[i])
                accelerations(u[i], alpha, a[i])
            put_rates(moving, step, nodes, v, a)
            if call_rows(called.address, step, CLOSE) != 0:
                unsolved = np.int64(FAILED - 1)
                break
            impact += called.loss[0]
        if linked:
            sum_rows(rows, pressing)
        touching = len(held)
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
        passed += 1
        stops = changed > 0
        wrong = failed >= 0 or pressed.failure[0] >= 0 or unsolved != 0 or not np.isfinite(after[INTERNAL])
        wrong = wrong or stops
        looks = wrong or shortened
        if agree:
            looks, lost = any_rank(messages, looks)
            if lost != 0:
                break
        if looks or last_one:
            turned = -1
            if brief:
                pull_again(x, n_blocks, bars, springs, f, aside, np.empty(4))
            if not last_one:  # the state does not have the end of this step yet
                clear_ends(lanes, n)
                for block in range(n_blocks):
                    first, last = NODE_BLOCK * block, min(NODE_BLOCK * (block + 1), n)
                    how = alone[block], True
                    end_block(block, how, nodes, shared, state, f[first:last], (probes, values))
            start_of_step(x[:n].reshape(-1), h, v.reshape(-1), a.reshape(-1), before[:n].reshape(-1))
            if failed < 0 and shortened:
                turned = first_inverted(x, before, bars.ends, bars.watched)
            wrong = wrong or turned >= 0
            put_rates(moving, step, nodes, v, a)
        if agree and looks:
            stops, lost = any_rank(messages, wrong)
            if lost != 0:
                break
            wrong = wrong or stops
        if ending or wrong:
            if padded and not ending:
                clear_all_energies(bars, work)  # a failure, whose energies nothing reads
            end_at_contacts(held, shared, contact, u)
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
            record_contact(row, (touching, changes), pressed, walls, rows, impulses.v)
            probe_forces(probes, support, contact, touching, values)
            if due[step]:
                changes = 0
            recorded += 1
        for c in range(3 if carried else 0):
            impulses.half[SUPPORT, c] += jumps[0, c]
        powers[:] = after
        if stops or (wrong and not several):
            break
    return Made(
        done,
        passed,
        recorded,
        lost,
        changed,
        failed,
        turned,
        pressed.failure[0],
        pressed.failure[1],
        unsolved != 0,
        pressed.normals,
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
