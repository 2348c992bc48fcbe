"""What rows of the history need of a step of a batch, from sums over blocks of nodes to this rank's share of a row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..columns import BAR_ENERGIES, HEAD, PAIR, PROBED, WALL
from ..integrators._leapfrog import accelerations, centre, kick
from ..mechanics.compiled import borrowing, kernel
from ..mechanics.runs import copy
from ..mesh.ordering import NODE_BLOCK
from .impulses import IN_COLUMNS, WALLS
from .ledger_loops import (
    CONTACT,
    DAMPING,
    ENDS,
    EXTERNAL,
    INERTIAL,
    INTERNAL,
    LANES,
    WORKS,
    add_ends,
    add_free_ends,
    add_powers,
    spread,
)


class ProbeArrays(NamedTuple):
    """Nodes (p,) of probes, ascending; the first one of each block of nodes, ``starts`` (blocks + 1,); and their places
    in ``order`` (p,)."""

    nodes: np.ndarray
    starts: np.ndarray
    order: np.ndarray


class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


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
def end_block(block, how, nodes, shared, state, forces, probed):
    """Add what the ledger needs of the end of a step at the nodes of a block to the sums, and write the values of its
    probes; ``probed``: ProbeArrays, and their values (p, 4, 3).

    ``how``: whether forces (m, 3) of the block alone determine its increments; whether these, velocities and
    accelerations are kept in the state.
    """
    alone, keep = how
    h, eta, alpha, ends, lanes = shared.h, shared.eta, shared.alpha, shared.ends, shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    wide = 3 * (last - first)
    u, left, force = ends.u[:wide], ends.left[:wide], forces.reshape(-1)
    x, half = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    held = nodes.support_starts[block] < nodes.support_starts[block + 1]
    probes = probed[0].starts[block] < probed[0].starts[block + 1]
    if alone and not (keep or held or probes or len(nodes.external) > 0):
        given = shared.inverses[first:last], half, force, x, nodes.mass[first:last]
        add_free_ends(given, (h, alpha, eta), lanes)
        return
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
    add_ends((u, half, force, x, nodes.mass[first:last]), (h, alpha, eta), lanes)
    if len(nodes.external) > 0 or len(nodes.damping) > 0:
        for j in range(wide):
            left[j] = (0.5 * h) * ((half[j] - eta * u[j]) - (0.5 * h) * (alpha * u[j]))
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
    _probe(block, u, shared, *probed)


@borrowing
def end_at_contacts(held, shared, contact, u):
    """Add the works of the forces of walls and rows over the half step at the nodes that are ``held``."""
    h, alpha, eta, half, works = shared.h, shared.alpha, shared.eta, shared.half, shared.lanes[ENDS + CONTACT]
    for i in held:
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
def record_contact(row, counts, pressed, walls, rows, particles):
    """Write sums of walls, tables and impulses (rows, 3) to this rank's share of a row; ``counts``: active contacts,
    and contacts that have changed since the last row."""
    row[_PRESSING] = counts[0]
    w, t = len(pressed.contacts), len(rows.totals)
    at, jumps = _CHANGES + (1 if w > 0 else 0), WALLS + w + t
    if w > 0:
        row[_CHANGES] = counts[1]
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
def _probe(block, u, shared, probes, values):
    """Write positions, velocities and accelerations of the probes in a block with increments ``u`` (3 m,)."""
    first = NODE_BLOCK * block
    for k in range(probes.starts[block], probes.starts[block + 1]):
        i, at = probes.nodes[k], probes.order[k]
        for c in range(3):
            step = u[3 * (i - first) + c]
            values[at, 0, c] = shared.x[i, c]
            values[at, 1, c], values[at, 2, c] = shared.half[i, c] - shared.eta * step, shared.alpha * step
