"""The fused loop: many steps of central differences in one compiled call, if nothing between them needs Python.

It applies to lumped mass, bars of one section on each rank, no walls or flat walls at rest, and constant loads and
supports. It calls the loops of single steps in the same order, so the results are bitwise identical. For a few thousand
bars a step takes about as long as the calls from Python to its loops, which the fused loop avoids.

With several ranks the loop itself exchanges the positions of ghosts. A rank on which a step fails keeps its state and
goes on exchanging, because the others do not know of it before the next row.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from ..contact.flat import press_planes
from ..contact.impact_loops import join_nodes, plane_gaps, stop_nodes, unpressed
from ..contact.log import compare_contacts
from ..integrators._leapfrog import advance, advance_loaded, centre, drift, kick
from ..mechanics.bar_geometry import first_inverted
from ..mechanics.compiled import inlined, kernel
from ..mechanics.rows import CHUNK
from ..mesh.ordering import NODE_BLOCK
from ..output.sums import HEAD
from .balance_loops import (
    CONTACT,
    INTERNAL,
    REACTIONS,
    add_drags,
    add_loads,
    add_powers,
    add_sparse_forces,
    add_sparse_powers,
    book_row,
    clear_forces,
    clear_sums,
    new_sums,
    start_of_step,
    sum_balance,
)
from .book_loops import WORKS, new_lanes, spread
from .ghost_loops import trade_positions
from .impulses import WALLS, fill_impulses
from .node_loops import accelerations, explicit_increments, hold, hold_still, react
from .sum_loops import add_totals, fill_bars, fill_probes, fill_walls, fill_works

__all__ = ["make_fused_loop"]


_HEAD, _KINETIC = HEAD.width, HEAD.first("kinetic_energy")  # constants of the machine code
_CONTACTS, _ALARM = HEAD.first("active_contacts"), HEAD.first("alarm")
_SLACK, _IMPACT = HEAD.first("slack_bars"), HEAD.first("impact_dissipation")


@cache
def make_fused_loop(
    forces: Callable,
    sum_energies: Callable,
    clear_energies: Callable,
    work_rows: int,
) -> Callable:
    """Return the fused loop for a law and strain measure.

    ``forces`` is the bar loop over a part of a sweep, with the functions for its energies and the number of its working
    arrays, see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.

    Its arguments are the maximum number of steps; the step [s]; positions, positions of the previous step, which are
    computed for the last step alone, and velocities at half steps (n, 3); arrays of bars, nodes, walls, probes,
    messages, and of the state; nodes (m,) that touch walls; nodes (k,) that have touched walls and not left them; the
    ledger's sums and its works of balances; its particles; whether a row of the history is ``due`` (count,) after each
    step; and ``sums`` (count, width), which receives the sums of the rows that are due, and for each step the changes
    of contacts. Velocities, accelerations, momenta and energies are computed only where a row is due, and after the
    last step.

    It returns the number of steps made, and MPI's error code; for the last step, which is the last one too if bars
    change their state of rupture there, the number of these bars, the first bar that collapsed and the first that went
    through zero length, or -1, and the infeasible node, or -1, with the offsets of its planes; the kinetic energy [J];
    increments (n, 3); the results of :func:`~pfem_petsc.contact.flat.press_planes` for nodes and walls; and the nodes
    that touch walls, and those that have touched them.
    """

    @inlined
    def move_block(block, n, x, h, half, f):
        """Move the nodes of a block, and set their forces to zero."""
        first = NODE_BLOCK * block
        last = min(first + NODE_BLOCK, n)
        where, sums = x[first:last].reshape(-1), f[first:last].reshape(-1)
        drift(where, h, half[first:last].reshape(-1), where)
        for j in range(len(sums)):
            sums[j] = 0.0

    @kernel
    def fused_loop(
        count,
        h,
        x,
        before,
        half,
        bars,
        nodes,
        walls,
        probes,
        messages,
        state,
        touched,
        met,
        ledger,
        powers,
        impulses,
        due,
        sums,
    ):
        n = len(half)
        n_walls = len(walls.offsets)
        f, a, v, support, contact = state.f, state.a, state.v, state.support, state.contact
        energies = state.energies
        alpha = 1.0 / (h * h)
        eta = 0.5 / h
        nothing = np.empty((0, 3))
        supported, loaded = len(nodes.support_nodes) > 0, len(nodes.external) > 0
        damped = len(nodes.damping) > 0
        # increments are kept where forces alone do not determine them
        kept = n_walls > 0 or damped
        predictor = np.empty((n if kept else 0, 3))
        inverse, inverses = np.empty(3 * NODE_BLOCK), np.empty(0 if kept else n)
        for i in range(len(inverses)):
            inverses[i] = 1.0 / (alpha * nodes.mass[i])
        u = np.empty((n, 3))
        stiffness = np.empty(n)
        load, held = np.empty(len(nodes.support_nodes)), np.empty(len(nodes.support_nodes))
        speeds, drag = np.empty(3 * NODE_BLOCK), np.empty(3 * NODE_BLOCK if damped else 0)
        ends, totals, lanes, room = np.empty(len(WORKS)), np.zeros((6, 3)), new_sums(), new_lanes()
        row_lanes, after = new_sums(), np.empty(len(WORKS))
        work = np.empty(work_rows * CHUNK)
        pushes, push_u = np.zeros(impulses.v.shape), np.empty(impulses.v.shape)
        counted, still = np.ones(n_walls, dtype=np.bool_), np.zeros((n_walls, 3))
        near = np.empty(0, dtype=np.int64)
        stuck_offsets = np.empty((0, n_walls))
        force, moment = np.zeros((n_walls, 3)), np.zeros((n_walls, 3))
        contacts = np.zeros(n_walls, dtype=np.int64)
        touching, places = np.empty((0, n_walls), dtype=np.bool_), np.empty((0, 3))
        pressed = touched  # nodes with entries in the array of wall forces
        n_blocks = (n + NODE_BLOCK - 1) // NODE_BLOCK
        failed = -1
        turned = -1
        infeasible = -1
        changed = 0
        done = 0
        kinetic = 0.0
        several = len(x) > n or messages.count > 0
        lost = 0  # error code of MPI
        for step in range(count):
            row = sums[step]
            row[_ALARM] = 0.0
            if failed >= 0 or turned >= 0 or infeasible >= 0:
                # the other ranks still need messages, until all know of the failure
                row[_ALARM] = 1.0
                lost = trade_positions(messages, x, before, False)
                continue
            for i in pressed:
                contact[i] = 0.0
            clear_forces(lanes, n, supported, loaded, damped)
            shortened, changed = False, 0
            changes = 0
            moved = 0
            if several:
                while moved < n_blocks:
                    move_block(moved, n, x, h, half, f)
                    moved += 1
                for i in range(n, len(x)):
                    f[i, 0] = f[i, 1] = f[i, 2] = 0.0
                lost = trade_positions(messages, x, before, True)
                if lost != 0:
                    break
                failed, shortened, changed = forces(
                    x,
                    bars.sweep,
                    bars.sweep.counted,
                    len(bars.sweep.diagonal),
                    bars.far,
                    bars.rest,
                    bars.heat,
                    bars.parameters,
                    bars.area,
                    h,
                    bars.history,
                    True,
                    f,
                    work,
                )
            clear_energies(work)
            # Blocks of nodes pass once through the cache: each moves shortly before its first bar, and is finished
            # after its last one, which belongs to its own block or to one before. Walls take all nodes in between.
            for stage in range(2):
                if stage == 1:
                    if n_walls == 0:
                        break
                    near, infeasible, stuck_offsets, total, touching, places, force, contacts, moment = press_planes(
                        predictor,
                        u,
                        walls.fixed,
                        walls.normals,
                        walls.offsets,
                        walls.all_nodes,
                        walls.members,
                        walls.tolerance,
                        stiffness,
                        walls.room,
                    )
                    for j in range(len(near)):
                        contact[near[j]] = total[j]
                    pressed = near
                    if len(near) > 0 or len(touched) > 0:
                        changes, touched = compare_contacts(
                            walls.touching, touched, near, touching, walls.present, walls.releases
                        )
                for block in range(n_blocks):
                    first = NODE_BLOCK * block
                    last = min(first + NODE_BLOCK, n)
                    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
                    part_u, part_stiffness = u[first:last], stiffness[first:last]
                    ahead = half[first:last].reshape(-1)
                    if stage == 0:
                        while moved < min(block + 1 + bars.reach, n_blocks):
                            move_block(moved, n, x, h, half, f)
                            moved += 1
                        if block < len(bars.sweep.parts) - 1:
                            at, short, broke = forces(
                                x,
                                bars.sweep,
                                bars.sweep.parts[block],
                                bars.sweep.parts[block + 1],
                                bars.far,
                                bars.rest,
                                bars.heat,
                                bars.parameters,
                                bars.area,
                                h,
                                bars.history,
                                True,
                                f,
                                work,
                            )
                            failed = at if failed < 0 else failed
                            shortened = shortened or short
                            changed += broke
                        if not kept:
                            here = speeds[: 3 * (last - first)]
                            factors = inverse[: 3 * (last - first)]
                            spread(inverses[first:last], factors)
                            hold_still(
                                begin,
                                end,
                                first,
                                nodes.support_nodes,
                                nodes.support_components,
                                nodes.support_positions,
                                nodes.mass,
                                nodes.external,
                                f,
                                x,
                                half,
                                h,
                                alpha,
                                factors,
                                held,
                                support,
                            )
                            pulls = f[first:last].reshape(-1)
                            if loaded:
                                load_here = nodes.external[first:last].reshape(-1)
                                advance_loaded(pulls, load_here, factors, alpha, eta, h, ahead, here, lanes[INTERNAL])
                                add_loads(load_here, here, lanes)
                            else:
                                advance(pulls, factors, alpha, eta, h, ahead, lanes[INTERNAL])
                            for k in range(begin, end):
                                i, c = nodes.support_nodes[k], nodes.support_components[k]
                                half[i, c] += h * (alpha * held[k])
                            add_sparse_forces(
                                begin, end, nodes.support_nodes, nodes.support_components, support, lanes[REACTIONS]
                            )
                            continue
                        explicit_increments(
                            nodes.external[first:last] if loaded else nothing,
                            f[first:last],
                            nodes.mass[first:last],
                            nodes.damping[first:last] if damped else nodes.damping,
                            alpha,
                            eta,
                            nothing,
                            half[first:last] if damped else nothing,
                            part_stiffness,
                            part_u,
                        )
                        where = predictor[first:last]
                        drift(x[first:last].reshape(-1), h, ahead, where.reshape(-1))
                        hold(
                            begin,
                            end,
                            first,
                            nodes.support_nodes,
                            nodes.support_components,
                            nodes.support_positions,
                            where,
                            part_stiffness,
                            part_u,
                            load,
                        )
                        if n_walls > 0:
                            continue
                    react(
                        begin,
                        end,
                        first,
                        nodes.support_nodes,
                        nodes.support_components,
                        load,
                        contact,
                        part_stiffness,
                        part_u,
                        support,
                    )
                    increments, here = part_u.reshape(-1), speeds[: 3 * (last - first)]
                    kick(increments, alpha, h, ahead)
                    centre(increments, eta, ahead, here)
                    add_powers(f[first:last].reshape(-1), here, lanes[INTERNAL])
                    add_sparse_forces(
                        begin, end, nodes.support_nodes, nodes.support_components, support, lanes[REACTIONS]
                    )
                    if loaded:
                        add_loads(nodes.external[first:last].reshape(-1), here, lanes)
                    if damped:
                        add_drags(nodes.damping[first:last], here, drag, lanes)
            impact = 0.0
            if len(near) > 0:
                for i in near:
                    centre(u[i], eta, half[i], v[i])
                clear_sums(lanes[CONTACT], n)
                add_sparse_powers(near, contact, v, lanes[CONTACT])
            if len(touched) > 0 or len(met) > 0:
                around = join_nodes(met, touched, walls.present)
                for i in around:
                    centre(u[i], eta, half[i], v[i])
                    accelerations(u[i], alpha, a[i])
                all_normals, gaps = plane_gaps(around, x, walls.normals, walls.offsets)
                free_v, free_a = unpressed(around, v, a, contact, nodes.mass, nodes.damping, alpha, eta)
                impact, met = stop_nodes(
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
                    counted,
                    walls.slack,
                    np.empty(gaps.shape),
                )
            after[:] = powers
            sum_balance(lanes, n, h, supported, loaded, len(near) > 0, damped, totals, after)
            pushes[:WALLS] = totals[3:]
            for k in range(n_walls):
                pushes[WALLS + k] = force[k]
            for k in range(len(pushes)):
                for c in range(3):
                    push_u[k, c] = pushes[k, c] / alpha
            kick(push_u.reshape(-1), alpha, h, impulses.half.reshape(-1))
            ledger[_IMPACT] += impact
            at = _HEAD
            if n_walls > 0:
                row[at] = changes
                at = fill_walls(row, at + 1, force, moment, impulses.v, contacts, walls.releases)
            done += 1
            wrong = failed >= 0 or infeasible >= 0 or changed > 0 or not np.isfinite(after[INTERNAL])
            if due[step] or shortened or wrong or step == count - 1:
                if not kept:
                    explicit_increments(
                        nodes.external, f[:n], nodes.mass, nodes.damping, alpha, eta, nothing, nothing, stiffness, u
                    )
                    for k in range(len(held)):
                        u[nodes.support_nodes[k], nodes.support_components[k]] = held[k]
                turned = -1
                centre(u.reshape(-1), eta, half.reshape(-1), v.reshape(-1))
                accelerations(u.reshape(-1), alpha, a.reshape(-1))
                if shortened or wrong or step == count - 1:
                    start_of_step(x[:n].reshape(-1), h, v.reshape(-1), a.reshape(-1), before[:n].reshape(-1))
                if failed < 0 and shortened:
                    turned = first_inverted(x, before, bars.ends, bars.watched)
                wrong = wrong or turned >= 0
            if due[step] or wrong or step == count - 1:
                for k in range(len(energies)):
                    energies[k] = 0.0
                sum_energies(work, energies)
                stored = 0.0
                for k in range(len(energies)):
                    stored += energies[k]
                pushed = contact if len(near) > 0 else nothing
                kinetic = book_row(
                    x[:n],
                    nodes.mass,
                    v,
                    a,
                    f[:n],
                    nodes.external,
                    nodes.damping,
                    pushed,
                    h,
                    row_lanes,
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
                row[_CONTACTS] = len(near)
                row[_ALARM] = 1.0 if failed >= 0 or turned >= 0 or infeasible >= 0 else 0.0
                if bars.slack >= 0:
                    slack = 0.0
                    for k in range(bars.counted):
                        slack += bars.history[bars.slack, k]
                    row[_SLACK] = slack
                if n_walls > 0:
                    at = fill_walls(row, _HEAD + 1, force, moment, impulses.v, contacts, walls.releases)
                reaction = support if supported else nothing
                fill_probes(row, at, probes.nodes, probes.places, probes.counts, x, v, a, contact, reaction)
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
            stuck_offsets,
            kinetic,
            u,
            (force, contacts, moment, near, touching, places),
            touched,
            met,
        )

    return fused_loop
