"""The fused loop: many steps of central differences in one compiled call, if nothing between them needs Python.

It applies to one rank, lumped mass, bars of one section, no walls or flat walls at rest, and constant loads and
supports. It calls the loops of single steps in the same order, so the results are bitwise identical. For a few thousand
bars a step takes about as long as the calls from Python to its loops, which the fused loop avoids.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from ..contact.flat import press_planes
from ..contact.impact_loops import join_nodes, plane_gaps, stop_nodes, unpressed
from ..contact.log import compare_contacts
from ..mechanics.bar_geometry import first_inverted
from ..mechanics.compiled import kernel
from ..mechanics.rows import CHUNK
from ..mesh.ordering import NODE_BLOCK
from ..output.sums import HEAD
from .book_loops import WORKS, book_part, book_supports, clear_lanes, new_lanes, sum_lanes
from .impulses import WALLS, fill_impulses
from .node_loops import explicit_increments, hold, leave_positions, react
from .sum_loops import add_totals, add_works, fill_bars, fill_probes, fill_walls

__all__ = ["make_fused_loop"]


_HEAD, _KINETIC = HEAD.width, HEAD.first("kinetic_energy")  # constants of the machine code
_CONTACTS, _ALARM = HEAD.first("active_contacts"), HEAD.first("alarm")
_SLACK = HEAD.first("slack_bars")


@cache
def make_fused_loop(
    forces: Callable, sum_energies: Callable, clear_energies: Callable, work_rows: int, drift: Callable, kick: Callable
) -> Callable:
    """Return the fused loop for a law and strain measure, and a scheme.

    ``forces`` is the bar loop over a part of a sweep, with the functions for its energies and the number of its working
    arrays, see :func:`~pfem_petsc.mechanics.kernels.make_kernels`; ``drift`` and ``kick`` are the loops of the scheme.

    Its arguments are the maximum number of steps; the step [s]; positions, positions of the previous step, and
    velocities at half steps (n, 3); arrays of bars, nodes, walls, probes and buffers; nodes (m,) that touch walls;
    nodes (k,) that have touched walls and not left them; the ledger's sums; its particles; the kinetic energy and the
    energies of the bars [J]; whether a row of the history is ``due`` (count,) after each step, else momenta are not
    computed; and ``sums`` (count, width), which receives the sums of a row for each step.

    It returns the number of steps made; for the last step, which is the last one too if bars change their state of
    rupture there, the number of these bars, the first bar that collapsed and the first that went through zero length,
    or -1, and the infeasible node, or -1, with the offsets of its planes; the buffers; the kinetic energy; increments
    (n, 3); the results of :func:`~pfem_petsc.contact.flat.press_planes` for nodes and walls; and the nodes that touch
    walls, and those that have touched them.
    """

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
        buffers,
        touched,
        met,
        ledger,
        impulses,
        kinetic,
        energies,
        due,
        sums,
    ):
        n = len(x)
        n_walls = len(walls.offsets)
        f, f1, a, a1, v, v1, support, support1, contact, contact1 = buffers
        energies1 = np.empty_like(energies)
        alpha = 1.0 / (h * h)
        eta = 0.5 / h
        nothing = np.empty((0, 3))
        supported = len(nodes.support_nodes) > 0
        # positions in the absence of forces, which walls need of all nodes and supports of a block
        predictor = np.empty((n if n_walls > 0 else min(n, NODE_BLOCK), 3))
        u = np.empty((n, 3))
        stiffness = np.empty(n)
        load = np.empty(len(nodes.support_nodes))
        works, totals, lanes = np.empty(len(WORKS)), np.zeros((6, 3)), new_lanes()
        work = np.empty(work_rows * CHUNK)
        pushes, push_u = np.zeros(impulses.v.shape), np.empty(impulses.v.shape)
        counted, still = np.ones(n_walls, dtype=np.bool_), np.zeros((n_walls, 3))
        near = np.empty(0, dtype=np.int64)
        stuck_offsets = np.empty((0, n_walls))
        force, moment = np.zeros((n_walls, 3)), np.zeros((n_walls, 3))
        contacts = np.zeros(n_walls, dtype=np.int64)
        touching, places = np.empty((0, n_walls), dtype=np.bool_), np.empty((0, 3))
        pressed, pressed_before = touched, touched  # nodes with entries in the two arrays of wall forces
        n_blocks = (n + NODE_BLOCK - 1) // NODE_BLOCK
        failed = -1
        turned = -1
        infeasible = -1
        changed = 0
        done = 0
        for step in range(count):
            f, f1 = f1, f
            a, a1 = a1, a
            v, v1 = v1, v
            if supported:
                support, support1 = support1, support
            contact, contact1 = contact1, contact
            pressed, pressed_before = pressed_before, pressed
            for i in pressed:
                contact[i] = 0.0
            energies1[:] = 0.0
            clear_energies(work)
            clear_lanes(lanes, n)
            failed, shortened, changed = -1, False, 0
            infeasible = -1
            changes = 0
            any_contact = False
            moved = 0
            # increments of all nodes are kept for walls and after the last step, else those of a block alone
            kept = n_walls > 0 or bars.can_break or step == count - 1
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
                    any_contact = len(pressed) > 0 or len(pressed_before) > 0
                for block in range(n_blocks):
                    first = NODE_BLOCK * block
                    last = min(first + NODE_BLOCK, n)
                    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
                    if stage == 0:
                        while moved < min(block + 1 + bars.reach, n_blocks):
                            low = NODE_BLOCK * moved
                            high = min(low + NODE_BLOCK, n)
                            where = x[low:high].reshape(-1)
                            leave_positions(where, before[low:high].reshape(-1), f[low:high].reshape(-1))
                            drift(where, h, half[low:high].reshape(-1), where)
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
                        if kept:
                            part_u, part_stiffness = u[first:last], stiffness[first:last]
                        else:
                            part_u, part_stiffness = u[: last - first], stiffness[: last - first]
                        loaded, damped = len(nodes.external) > 0, len(nodes.damping) > 0
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
                        where, ahead = x[first:last].reshape(-1), half[first:last].reshape(-1)
                        if n_walls > 0:
                            drift(where, h, ahead, predictor[first:last].reshape(-1))
                        elif end > begin:
                            drift(where, h, ahead, predictor[: last - first].reshape(-1))
                        hold(
                            begin,
                            end,
                            first,
                            nodes.support_nodes,
                            nodes.support_components,
                            nodes.support_positions,
                            predictor[first:last] if n_walls > 0 else predictor,
                            part_stiffness,
                            part_u,
                            load,
                        )
                        if n_walls > 0:
                            continue
                    else:
                        part_u, part_stiffness = u[first:last], stiffness[first:last]
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
                    kick(
                        part_u.reshape(-1),
                        alpha,
                        eta,
                        h,
                        half[first:last].reshape(-1),
                        a[first:last].reshape(-1),
                        v[first:last].reshape(-1),
                    )
                    book_part(
                        first,
                        last,
                        due[step],
                        before,
                        x,
                        nodes.mass,
                        nodes.mass,
                        v,
                        v,
                        nothing,
                        nodes.damping,
                        a1,
                        a,
                        v1,
                        v,
                        f1,
                        f,
                        nodes.external,
                        nodes.external,
                        nothing,
                        nothing,
                        contact1 if any_contact else nothing,
                        contact if any_contact else nothing,
                        lanes,
                    )
                    book_supports(
                        begin, end, nodes.support_nodes, nodes.support_components, before, x, support1, support, lanes
                    )
            turned = -1
            if failed < 0 and shortened:
                turned = first_inverted(x, before, bars.ends, bars.watched)
            sum_energies(work, energies1)
            kinetic1 = sum_lanes(lanes, n, due[step], totals, works)
            impact = 0.0
            if len(touched) > 0 or len(met) > 0:
                around = join_nodes(met, touched, walls.present)
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
            pushes[:WALLS] = totals[3:]
            for k in range(n_walls):
                pushes[WALLS + k] = force[k]
            for k in range(len(pushes)):
                for c in range(3):
                    push_u[k, c] = pushes[k, c] / alpha
            kick(
                push_u.reshape(-1),
                alpha,
                eta,
                h,
                impulses.half.reshape(-1),
                impulses.a.reshape(-1),
                impulses.v.reshape(-1),
            )
            held, held1 = 0.0, 0.0
            for k in range(len(energies)):
                held += energies[k]
                held1 += energies1[k]
            energies[:] = energies1
            stored = kinetic1 - kinetic + held1 - held
            kinetic = kinetic1
            add_works(ledger, works, stored, 0.0, impact, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            add_totals(ledger, totals)
            fill_impulses(ledger, impulses.v)
            ledger[_KINETIC] = kinetic
            row = sums[step]
            row[:_HEAD] = ledger
            fill_bars(row, energies)
            row[_CONTACTS], row[_ALARM] = len(near), 0.0
            if bars.slack >= 0:
                slack = 0.0
                for k in range(bars.history.shape[1]):
                    slack += bars.history[bars.slack, k]
                row[_SLACK] = slack
            at = _HEAD
            if n_walls > 0:
                row[at] = changes
                at = fill_walls(row, at + 1, force, moment, impulses.v, contacts, walls.releases)
            reaction = support if supported else nothing
            fill_probes(row, at, probes.nodes, probes.starts, x, v, a, contact, reaction)
            done += 1
            if failed >= 0 or turned >= 0 or infeasible >= 0 or changed > 0 or not np.isfinite(kinetic + held1):
                break
        after = (f, f1, a, a1, v, v1, support, support1, contact, contact1)
        return (
            done,
            changed,
            failed,
            turned,
            infeasible,
            stuck_offsets,
            after,
            kinetic,
            u,
            (force, contacts, moment, near, touching, places),
            touched,
            met,
        )

    return fused_loop
