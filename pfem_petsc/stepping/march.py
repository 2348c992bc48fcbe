"""Many steps of central differences in one compiled call, where nothing between them needs Python.

One rank, lumped mass, bars of one section, flat walls at rest or none, loads and supports that do not change: the loops
are those of single steps, in the same order, so the results are the same. A step of a few thousand bars takes about as
long as Python takes to call its loops one by one; here it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from ..contact.flat import press_planes
from ..contact.impact import join_nodes, plane_gaps, stop_nodes, unpressed
from ..contact.log import compare_contacts
from ..energies import BAR_ENERGIES
from ..integrators.central_differences import drift, kick
from ..mechanics.bars import first_inverted
from ..mechanics.compiled import kernel
from ..output.sums import HEAD, WALL
from .impulses import WALLS
from .node_loops import WORKS, book_nodes, explicit_increments, hold, react

__all__ = ["BarArrays", "Buffers", "ImpulseArrays", "NodeArrays", "ProbeArrays", "WallArrays", "make_march"]


# places of sums and works: constants of the machine code
_HEAD, _WALL = HEAD.width, WALL.width
_KINETIC, _BARS = HEAD.first("kinetic_energy"), tuple(HEAD.first(name) for name in BAR_ENERGIES)
_EXTERNAL, _DAMPING = HEAD.first("external_work"), HEAD.first("damping_dissipation")
_IMPACT, _NUMERICAL = HEAD.first("impact_dissipation"), HEAD.first("numerical_dissipation")
_TOTALS, _CONTACTS, _ALARM = HEAD.first("momentum"), HEAD.first("active_contacts"), HEAD.first("alarm")
_SUPPORT_IMPULSE, _EXTERNAL_IMPULSE = HEAD.first("support_impulse"), HEAD.first("external_impulse")
_DAMPING_IMPULSE = HEAD.first("damping_impulse")
_FORCE, _MOMENT, _IMPULSE = WALL.first("force"), WALL.first("moment"), WALL.first("impulse")
_TOUCHED, _RELEASES = WALL.first("contacts"), WALL.first("releases")
_BY_EXTERNAL, _BY_CONTACT, _BY_DAMPING, _BY_INERTIA, _BY_BARS = range(len(WORKS))


class BarArrays(NamedTuple):
    """Arguments of a law's loop over the bars; see :mod:`~pfem_petsc.mechanics.kernels`."""

    ends: np.ndarray
    sweep: tuple
    far: np.ndarray
    rest: np.ndarray
    heat: np.ndarray
    parameters: tuple
    area: float
    history: np.ndarray


class NodeArrays(NamedTuple):
    """What stays as it is at the nodes; ``damping`` (0,) and ``external`` (0, 3) for none."""

    mass: np.ndarray
    damping: np.ndarray
    external: np.ndarray
    support_nodes: np.ndarray
    support_components: np.ndarray
    support_positions: np.ndarray


class WallArrays(NamedTuple):
    """Flat walls and their log; see :mod:`~pfem_petsc.contact.flat` and :mod:`~pfem_petsc.contact.log`."""

    fixed: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    everyone: np.ndarray
    members: np.ndarray
    tolerance: float
    room: np.ndarray
    touching: np.ndarray
    present: np.ndarray
    releases: np.ndarray
    closed: np.ndarray
    restitution: np.ndarray
    slack: float


class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: what they remember, and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


class ProbeArrays(NamedTuple):
    """Nodes (m,) of all probes, one after the other, and where each probe starts (probes + 1,)."""

    nodes: np.ndarray
    starts: np.ndarray


class Buffers(NamedTuple):
    """Arrays (n, 3) that are filled in turn: of the last step, and to be filled by the next.

    Those for the forces of walls hold zeros, but for what the last step has put into the first of them.
    """

    f: np.ndarray
    f_next: np.ndarray
    a: np.ndarray
    a_next: np.ndarray
    v: np.ndarray
    v_next: np.ndarray
    support: np.ndarray
    support_next: np.ndarray
    contact: np.ndarray
    contact_next: np.ndarray


@cache
def make_march(forces: Callable) -> Callable:
    """The loop over steps for the bars' loop ``forces`` of a law and strain measure.

    Its arguments: most steps; step [s]; positions, those of the step before, velocities at half steps (n, 3); arrays of
    bars, nodes, walls, probes and buffers; nodes (m,) that touch walls; nodes (k,) that have met walls; the
    ledger's sums; its particles; the kinetic energy, and those of
    the bars [J]; and ``sums`` (count, width), which takes what a row of the history sums up, of each step.

    It gives the number of steps made; of the last of them the first bar that collapsed and the first that went through
    zero length, or -1, and the node that found no room, or -1, with the offsets of its planes; the buffers; the
    kinetic energy; increments (n, 3); what :func:`~pfem_petsc.contact.flat.press_planes` tells of nodes and walls; and
    the nodes that touch walls, and that have met them.
    """

    @kernel
    def march(
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
        sums,
    ):
        n = len(x)
        n_walls = len(walls.offsets)
        f, f1, a, a1, v, v1, support, support1, contact, contact1 = buffers
        energies1 = np.empty_like(energies)
        alpha = 1.0 / (h * h)
        eta = 0.5 / h
        nothing = np.empty((0, 3))
        flat_x, flat_before, flat_half = x.reshape(-1), before.reshape(-1), half.reshape(-1)
        predictor, u = np.empty((n, 3)), np.empty((n, 3))
        stiffness = np.empty(n)
        load = np.empty(len(nodes.support_nodes))
        works, totals = np.empty(len(WORKS)), np.empty((6, 3))
        pushes, push_u = np.zeros(impulses.v.shape), np.empty(impulses.v.shape)
        counted, still = np.ones(n_walls, dtype=np.bool_), np.zeros((n_walls, 3))
        supported = len(nodes.support_nodes) > 0
        rates = half if len(nodes.damping) > 0 else nothing
        near = np.empty(0, dtype=np.int64)
        stuck_offsets = np.empty((0, n_walls))
        force, moment = np.zeros((n_walls, 3)), np.zeros((n_walls, 3))
        contacts = np.zeros(n_walls, dtype=np.int64)
        touching, places = np.empty((0, n_walls), dtype=np.bool_), np.empty((0, 3))
        pressed, pressed_before = touched, touched  # nodes with entries in the two arrays of wall forces
        failed = -1
        turned = -1
        stuck = -1
        done = 0
        for step in range(count):
            flat_before[:] = flat_x
            drift(flat_x, h, flat_half, flat_x)
            f, f1 = f1, f
            f[:] = 0.0
            energies1[:] = 0.0
            failed, shortened = forces(
                x,
                *bars.sweep,
                bars.far,
                bars.rest,
                bars.heat,
                bars.parameters,
                bars.area,
                h,
                bars.history,
                True,
                f,
                energies1,
            )
            turned = -1
            if failed < 0 and shortened:
                turned = first_inverted(x, before, bars.ends, bars.rest)
            drift(flat_x, h, flat_half, predictor.reshape(-1))
            explicit_increments(nodes.external, f, nodes.mass, nodes.damping, alpha, eta, nothing, rates, stiffness, u)
            if supported:
                hold(
                    nodes.support_nodes,
                    nodes.support_components,
                    nodes.support_positions,
                    predictor,
                    stiffness,
                    u,
                    load,
                )
            changes = 0
            contact, contact1 = contact1, contact
            pressed, pressed_before = pressed_before, pressed
            for i in pressed:
                contact[i] = 0.0
            if n_walls > 0:
                near, stuck, stuck_offsets, total, touching, places, force, contacts, moment = press_planes(
                    predictor,
                    u,
                    walls.fixed,
                    walls.normals,
                    walls.offsets,
                    walls.everyone,
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
            if supported:
                support, support1 = support1, support
                react(nodes.support_nodes, nodes.support_components, load, contact, stiffness, u, support)
            a, a1 = a1, a
            v, v1 = v1, v
            kick(u.reshape(-1), alpha, eta, h, flat_half, a.reshape(-1), v.reshape(-1))
            any_contact = len(pressed) > 0 or len(pressed_before) > 0
            kinetic1 = book_nodes(
                before,
                x,
                nodes.mass,
                nodes.mass,
                v,
                v,
                support if supported else nothing,
                nodes.damping,
                a1,
                a,
                v1,
                v,
                f1,
                f,
                nodes.external,
                nodes.external,
                support1 if supported else nothing,
                support if supported else nothing,
                contact1 if any_contact else nothing,
                contact if any_contact else nothing,
                totals,
                works,
            )
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
            ledger[_EXTERNAL] += works[_BY_EXTERNAL]
            ledger[_DAMPING] += works[_BY_DAMPING]
            ledger[_IMPACT] += impact
            ledger[_NUMERICAL] += works[_BY_INERTIA] + works[_BY_BARS] - stored - works[_BY_CONTACT] - impact
            for k in range(4):
                for c in range(3):
                    ledger[_TOTALS + 3 * k + c] = totals[k, c]
            for c in range(3):
                ledger[_SUPPORT_IMPULSE + c] = impulses.v[0, c]
                ledger[_EXTERNAL_IMPULSE + c] = impulses.v[1, c]
                ledger[_DAMPING_IMPULSE + c] = impulses.v[2, c]
            ledger[_KINETIC] = kinetic
            row = sums[step]
            row[:_HEAD] = ledger
            for k in range(len(energies)):
                row[_BARS[k]] = energies[k]
            row[_CONTACTS], row[_ALARM] = len(near), 0.0
            at = _HEAD
            if n_walls > 0:
                row[at] = changes
                at += 1
                for k in range(n_walls):
                    row[at + _FORCE : at + _FORCE + 3] = force[k]
                    row[at + _MOMENT : at + _MOMENT + 3] = moment[k]
                    row[at + _IMPULSE : at + _IMPULSE + 3] = impulses.v[WALLS + k]
                    row[at + _TOUCHED], row[at + _RELEASES] = contacts[k], walls.releases[k]
                    at += _WALL
            for p in range(len(probes.starts) - 1):
                first, size = probes.starts[p], probes.starts[p + 1] - probes.starts[p]
                for j in range(size):
                    i = probes.nodes[first + j]
                    for c in range(3):
                        row[at + 3 * j + c] = x[i, c]
                        row[at + 3 * (size + j) + c] = v[i, c]
                        row[at + 3 * (2 * size + j) + c] = a[i, c]
                        row[at + 3 * (3 * size + j) + c] = contact[i, c] + (support[i, c] if supported else 0.0)
                at += 12 * size
            done += 1
            if failed >= 0 or turned >= 0 or stuck >= 0 or not np.isfinite(kinetic + held1):
                break
        after = (f, f1, a, a1, v, v1, support, support1, contact, contact1)
        return (
            done,
            failed,
            turned,
            stuck,
            stuck_offsets,
            after,
            kinetic,
            u,
            (force, contacts, moment, near, touching, places),
            touched,
            met,
        )

    return march
