"""The loop of a batch: many steps of central differences in one compiled call, on named arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from ..columns import HEAD
from ..contact.node_walls import compare_contacts
from ..integrators._leapfrog import centre
from ..mechanics.compiled import borrowing, kernel
from ..mechanics.elements import BarData, first_inverted
from ..mechanics.runs import Columns, exchange_history, new_rows, slide_planes
from ..mechanics.tuples import CHUNK
from ..mesh.ordering import NODE_BLOCK
from .batch_blocks import (
    RowSums,
    advance_block,
    complete,
    fill_row,
    find_pressed,
    finish_block,
    finish_positions,
    finish_rows,
    join_block,
    mark_blocks,
    move_block,
    new_pressed,
    pass_block,
    press_block,
    push_particles,
    solve_block,
    split_block,
    start_positions,
    stop_at_walls,
    sum_rows,
)
from .ledger_loops import (
    CONTACT,
    INTERNAL,
    WORKS,
    Acting,
    add_sparse_powers,
    clear_forces,
    clear_sums,
    fill_walls,
    new_row_room,
    new_sums,
    start_of_step,
    sum_balance,
)


class BarArrays(NamedTuple):
    """The bars of a batch: ``data`` of all of them; ``watched``, see ``Bars``; ``slack``: row of the history with the
    variable of this name, or -1; ``counted``: columns of the history that belong to counted bars; ``reach``: how
    many blocks of nodes beyond its own the bars of a block reach; ``columns`` of the bars, or none; ``planes`` and
    ``pulls`` (3 stride,): positions and forces by components, of a window of the nodes."""

    data: BarData
    watched: np.ndarray
    slack: int
    counted: int
    reach: int
    meeting: int
    can_break: bool
    columns: Columns
    planes: np.ndarray
    pulls: np.ndarray


class NodeArrays(NamedTuple):
    """Constant arrays at the nodes; ``damping`` (0,) and ``external`` (0, 3) if there are none;
    ``support_starts`` (blocks + 1,) the first prescribed component of each block of nodes, which are sorted by node."""

    mass: np.ndarray
    damping: np.ndarray
    external: np.ndarray
    support_nodes: np.ndarray
    support_components: np.ndarray
    support_positions: np.ndarray
    support_starts: np.ndarray


class WallArrays(NamedTuple):
    """Flat walls and their log; see :mod:`~pfem_petsc.contact.explicit` and :mod:`~pfem_petsc.contact.node_walls`."""

    fixed: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    all_nodes: np.ndarray
    members: np.ndarray
    tolerance: float
    room: np.ndarray
    touching: np.ndarray
    present: np.ndarray
    releases: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray
    slack: float


class BlockArrays(NamedTuple):
    """What the passes over blocks of nodes share: numbers of the scheme, see
    :mod:`~pfem_petsc.integrators._leapfrog`; positions ``x`` (local, 3) and velocities at half steps ``half`` (n, 3);
    ``inverses`` (n,) of the stiffness; ``factors``, ``speeds`` and ``drag``
    (3 NODE_BLOCK,) buffers of a block, the last one empty without damping; for prescribed components the increments
    ``held`` (k,) [m] and ``load`` (k,), the forces that would move them [N]; reactions ``support`` (n, 3) [N]; and
    ``lanes``, the sums of the balance, see :mod:`~pfem_petsc.stepping.ledger_loops`."""

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


class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


class ProbeArrays(NamedTuple):
    """Nodes of all probes, see :meth:`~pfem_petsc.run.recorder.Recorder.probed`."""

    nodes: np.ndarray
    places: np.ndarray
    counts: np.ndarray


class StateArrays(NamedTuple):
    """Arrays (n, 3) of the state, and the energies of the bars [J]. Wall forces are zero except at the nodes that touch
    walls; support forces are written at prescribed components alone."""

    f: np.ndarray
    a: np.ndarray
    v: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    energies: np.ndarray


class BatchData(NamedTuple):
    """All that a batch reads and writes: the step [s]; positions (local, 3), those of the previous step, which are
    computed for the last step alone, and velocities at half steps (n, 3); records of arrays; the ledger's sums and its
    works of balances; and its particles."""

    h: float
    x: np.ndarray
    before: np.ndarray
    half: np.ndarray
    bars: BarArrays
    nodes: NodeArrays
    walls: WallArrays
    rows: NamedTuple
    probes: ProbeArrays
    messages: NamedTuple
    state: StateArrays
    ledger: np.ndarray
    powers: np.ndarray
    impulses: ImpulseArrays


_HEAD, _ALARM = HEAD.width, HEAD.first("alarm")  # constants of the machine code
_IMPACT = HEAD.first("impact_dissipation")


@cache
def make_fused_loop(
    add_forces: Callable,
    sum_energies: Callable,
    clear_energies: Callable,
    work_rows: int,
    add_padded: Callable,
    padded_rows: int,
) -> Callable:
    """Return the fused loop for a law and strain measure.

    ``add_forces`` is the bar loop over a part of a sweep, with the functions for its energies and the number of its
    working arrays; ``add_padded``, with ``padded_rows`` working arrays, is the loop over columns, for steps
    whose energies nothing reads; see
    :func:`~pfem_petsc.mechanics.elements.make_loops`.

    Its arguments are BatchData; nodes (m,) that touch walls; nodes (k,) that have touched walls and not left them;
    whether a row of the history is ``due`` (count,) after each step; and ``sums`` (count, width), which receives the
    sums of the rows that are due, and for each step the changes of contacts. Velocities, accelerations, momenta and
    energies are computed only where a row is due, and after the last step.

    It returns the number of steps made, and MPI's error code; for the last step, which is the last one too if bars
    change their state of rupture there, the number of these bars, the first bar that collapsed and the first that went
    through zero length, or -1, and the infeasible node, or -1, with the offsets of its planes; the kinetic energy [J];
    increments (n, 3); the results of :func:`~pfem_petsc.contact.explicit.press_planes` for nodes and walls; the nodes
    that touch walls, and those that have touched them; and the number of nodes with contact forces.
    """

    @borrowing
    def pull(x, bars, begun, ended, f, work):
        """Add the forces of some chunks of bars."""
        return add_forces(x, bars.data, begun, ended, True, f, work)

    @borrowing
    def pull_again(x, n, bars, f, work, aside):
        """Compute all forces in the order of a step."""
        flat = f.reshape(-1)
        for j in range(len(flat)):
            flat[j] = 0.0
        if len(x) > n:
            pull(x, bars, bars.data.sweep.counted, len(bars.data.sweep.diagonal), f, aside)
        pull(x, bars, 0, bars.data.sweep.counted, f, work)

    @kernel
    def fused_loop(data, touched, met, due, sums):
        count, h, x, before, half = len(due), data.h, data.x, data.before, data.half
        bars, nodes, walls, rows, messages, state = (
            data.bars,
            data.nodes,
            data.walls,
            data.rows,
            data.messages,
            data.state,
        )
        ledger, powers, impulses = data.ledger, data.powers, data.impulses
        n = len(half)
        n_walls = len(walls.offsets)
        f, a, v, support, contact = state.f, state.a, state.v, state.support, state.contact
        energies = state.energies
        alpha = 1.0 / (h * h)
        eta = 0.5 / h
        supported, loaded = len(nodes.support_nodes) > 0, len(nodes.external) > 0
        damped = len(nodes.damping) > 0
        linked = len(rows.ready) > 0
        plain = n_walls == 0 and not damped and not linked  # forces alone determine increments
        increments, factors, inverses = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK), np.empty(n)
        for i in range(n):
            inverses[i] = 1.0 / (alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0))
        u = np.empty((n, 3))
        stiffness = np.empty(n)
        load, held = np.empty(len(nodes.support_nodes)), np.empty(len(nodes.support_nodes))
        speeds, drag = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK if damped else 0)
        ends, totals, lanes, room = np.empty(len(WORKS)), np.zeros((6, 3)), new_sums(), new_row_room()
        after = np.empty(len(WORKS))
        numbers, buffers = (h, alpha, eta), (factors, speeds, drag)
        shared = BlockArrays(*numbers, x, half, inverses, *buffers, held, load, support, lanes)
        work, columns_work = np.empty(work_rows * CHUNK), new_rows(padded_rows)
        pulled = np.empty((NODE_BLOCK, 3))  # forces of a block
        push_u = np.empty(impulses.v.shape)
        near = touched  # nodes with entries in the array of wall forces
        pressed = new_pressed(n, n_walls)
        n_blocks = (n + NODE_BLOCK - 1) // NODE_BLOCK
        # blocks whose forces alone determine their increments; blocks with nodes that touch walls or have touched them
        alone, on_walls = np.ones(n_blocks, dtype=np.bool_), np.zeros(n_blocks, dtype=np.bool_)
        for block in range(n_blocks if linked else 0):
            alone[block] = not (damped or rows.near[block])
        # fields that loops over blocks would count references to
        planes, pulls, parts, chunks = bars.planes, bars.pulls, bars.columns.parts, bars.data.sweep.parts
        room_for, reach = len(planes) // 3, bars.reach
        failed = -1
        turned = -1
        infeasible = -1
        changed = 0
        touching = 0
        done = 0
        kinetic = 0.0
        several = len(x) > n or messages.count > 0
        lost = 0  # error code of MPI
        aside = np.empty(len(work) if several else 0)  # energies of bars that other ranks count
        spread = False  # whether the history of the bars is that of the columns
        shortened = False
        for step in range(count):
            row = sums[step]
            row[_ALARM] = 0.0
            if failed >= 0 or turned >= 0 or infeasible >= 0:
                # the other ranks still need messages, until all know of the failure
                row[_ALARM] = 1.0
                lost = start_positions(messages, x, h, half)
                lost = finish_positions(messages, x, before, False) if lost == 0 else lost
                if lost != 0:
                    break
                continue
            for i in near:
                contact[i] = 0.0
            clear_forces(lanes, n, Acting(supported, loaded, False, damped))
            changed = 0
            changes = 0
            moved = 0
            base = 0  # first node of the planes
            # nothing reads the energies of other steps: a failure ends the run
            light = len(parts) > 0 and not (due[step] or step == count - 1)
            if light != spread:
                exchange_history(bars.data.sweep, bars.columns, bars.data.history, spread)
                spread = light
            # Forces that nothing reads stay in the cache. The check of shortened bars reads them, as the next one is
            # likely to; those of laws with history could not be computed again. Blocks that wait for rows need them.
            brief = light and not shortened and len(bars.data.history) == 0 and not linked
            forces = pulled if brief else f
            shortened = False
            if several:
                lost = start_positions(messages, x, h, half)
                if lost != 0:
                    break
            waiting = several
            clear_energies(work)
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
                        move_block(moved, shared, f, light, bars, base)
                        moved += 1
                    for i in range(n, len(x)):
                        f[i, 0] = f[i, 1] = f[i, 2] = 0.0
                    lost = finish_positions(messages, x, before, True)
                    if lost != 0:
                        break
                    broke = 0
                    if light:
                        split_block(n, len(x), x, planes, pulls, base)
                        groups = (bars.columns.counted, len(bars.columns.heads))
                        at, short = add_padded(x, bars, base, *groups, columns_work)
                    else:
                        groups = (bars.data.sweep.counted, len(bars.data.sweep.diagonal))
                        at, short, broke = pull(x, bars, *groups, f, aside)
                    failed = at if at >= 0 else failed
                    shortened = shortened or short
                    changed += broke
                    waiting = False
                if block == n_blocks:
                    break
                while moved < min(block + 1 + reach, n_blocks):
                    if light and not several and room_for < NODE_BLOCK * (moved + 1) - base:
                        live = NODE_BLOCK * block
                        slide_planes(planes, live - base, NODE_BLOCK * moved - live)
                        slide_planes(pulls, live - base, NODE_BLOCK * moved - live)
                        base = live
                    move_block(moved, shared, f, light, bars, base)
                    moved += 1
                start = NODE_BLOCK * block if brief else 0
                if light:
                    if block < len(parts) - 1:
                        at, short = add_padded(x, bars, base, parts[block], parts[block + 1], columns_work)
                        failed = at if failed < 0 else failed
                        shortened = shortened or short
                    join_block(block, n, pulls, base, forces, start)
                elif block < len(chunks) - 1:
                    at, short, broke = pull(x, bars, chunks[block], chunks[block + 1], f, work)
                    failed = at if failed < 0 else failed
                    shortened = shortened or short
                    changed += broke
                if plain:
                    advance_block(block, nodes, shared, forces, start)
                    continue
                if linked:
                    arrays = (f, u, contact)
                    finished, pressing, more = pass_block(
                        block, (finished, pressing), rows, alone, nodes, shared, arrays
                    )
                    altered += more
                    continue
                first, last = NODE_BLOCK * block, min(NODE_BLOCK * (block + 1), n)
                free, here = speeds[: 3 * (last - first)], increments[: 3 * (last - first)]
                solve_block(block, nodes, shared, forces, start, free, here)
                found = find_pressed(block, walls, free) if n_walls > 0 else 0
                if found > 0:
                    counts, out = (found, count_near), (contact, pressed)
                    at = press_block(block, counts, nodes, walls, shared, (free, here), out)
                    infeasible = at if infeasible < 0 else infeasible
                    count_near += found
                finish_block(block, nodes, shared, forces, start, contact, here)
                alone[block] = not (damped or on_walls[block] or found > 0)
                if not alone[block]:
                    kept = u[first:last].reshape(-1)
                    for j in range(len(here)):
                        kept[j] = here[j]
            if n_walls > 0:
                mark_blocks(on_walls, touched, False)
                mark_blocks(on_walls, met, False)
                near = pressed.nodes[:count_near]
                if count_near > 0 or len(touched) > 0:
                    changes, touched = compare_contacts(
                        walls.touching, touched, near, pressed.touching, walls.present, walls.releases
                    )
            if lost != 0:
                break
            impact = 0.0
            if len(near) > 0:
                for i in near:
                    centre(u[i], eta, half[i], v[i])
                clear_sums(lanes[CONTACT], n)
                add_sparse_powers(near, contact, v, lanes[CONTACT])
            if len(touched) > 0 or len(met) > 0:
                impact, met = stop_at_walls(nodes, walls, shared, state, u, touched, met)
            if altered > 0:
                impact += finish_rows(rows, altered, walls.slack, nodes, shared, state, u)
            sum_rows(rows, pressing)
            touching = len(near) + 2 * pressing
            after[:] = powers
            sum_balance(lanes, n, h, Acting(supported, loaded, touching > 0, damped), totals, after)
            push_particles(totals, pressed.force, rows.totals, alpha, h, impulses, push_u)
            ledger[_IMPACT] += impact
            if n_walls > 0:
                row[_HEAD] = changes
                fill_walls(row, _HEAD + 1, pressed.force, pressed.moment, impulses.v, pressed.contacts, walls.releases)
            done += 1
            wrong = failed >= 0 or infeasible >= 0 or changed > 0 or not np.isfinite(after[INTERNAL])
            if due[step] or shortened or wrong or step == count - 1:
                turned = -1
                if brief:
                    pull_again(x, n, bars, f, work, aside)
                complete(nodes, shared, state, alone, stiffness, u)
                if shortened or wrong or step == count - 1:
                    start_of_step(x[:n].reshape(-1), h, v.reshape(-1), a.reshape(-1), before[:n].reshape(-1))
                if failed < 0 and shortened:
                    turned = first_inverted(x, before, bars.data.ends, bars.watched)
                wrong = wrong or turned >= 0
            if due[step] or wrong or step == count - 1:
                if light:
                    exchange_history(bars.data.sweep, bars.columns, bars.data.history, True)
                    spread = False
                else:
                    for k in range(len(energies)):
                        energies[k] = 0.0
                    sum_energies(work, energies)
                of_walls = (pressed.force, pressed.moment, pressed.contacts, walls.releases)
                row_sums = RowSums(push_u, *of_walls, rows.totals, touching, totals, room, ends)
                kinetic = fill_row(data, row_sums, row)
                row[_ALARM] = 1.0 if failed >= 0 or turned >= 0 or infeasible >= 0 else 0.0
            powers[:] = after
            if wrong and not several:
                break
        return (
            done,
            lost,
            changed,
            failed,
            turned,
            infeasible,
            pressed.offsets,
            kinetic,
            u,
            (
                pressed.force,
                pressed.contacts,
                pressed.moment,
                near.copy(),
                pressed.touching[: len(near)].copy(),
                pressed.places[: len(near)].copy(),
            ),
            touched,
            met,
            touching,
        )

    return fused_loop
