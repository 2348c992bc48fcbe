"""Contact of bars with bars: capsules that repel each other where their axes are closer than the sum of their radii.

The energy of two bars with the sum of radii R is

    E = m phi(d) + (1 - m)/2 (phi(d_1) + ... + phi(d_4)),    phi(d) = k/2 max(R - d, 0)^2

with the distance d of their axes and those of each of the four ends from the other axis, d_1 to d_4. m goes from 0 for
parallel bars to 1 where the sine of the angle between them reaches R over the length of the shorter one, or the root
of :data:`_CROSSED`, with two continuous derivatives: bars that cross touch in one point, those that are parallel up to
their thickness at the ends of where they lie side by side, and nothing jumps in between. Distances are minima over
parameters within the bars, whose derivatives are not needed (envelope theorem): forces act along the line between the
closest points. Momentum and angular momentum are conserved; friction, which acts on the axes and not on the surfaces,
turns bars too little by its moment about them, as bars of a truss have no torsion.

The stiffness k of a pair is that of its bars, :data:`_STIFFNESS` times the harmonic mean of E A/l, unless the step
requires less: by Gershgorin's theorem the square of the frequency of a node with the mass m grows by at most the sum of
2 w k/m over the pairs that touch it, with its weights w in their closest points. Those that begin to touch in a step
get at most :data:`_PART` of what the step and the others leave. The stiffness is constant while the pair touches.
Pairs closer than R in the mesh keep their distance there instead of R, and do not touch below :data:`_LEAST` of it.

Bars are searched with a skin. Pairs are evaluated when the ways of the nodes since then allow them to touch; a bar that
could jump over another in an explicit step, or has passed its axis, ends the run.

Steps that solve equations try positions from the last ones that were committed, with forces and memory as at the end of
the step. The derivative of the force is that of the same code, for complex positions. The way from one iteration to
the next is shortened where a pair would come too close (:func:`free_part`), so that positions are always those of a
motion in which no bar passes another. k is E A/l there, whatever the step. Matrices have the pairs that touch in their
pattern, which begins anew with each problem and grows with its iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..columns import STATUS
from ..errors import InputError, SimulationFailure
from ..mechanics.compiled import add_freely, inlined, kernel
from ..mesh.distribution import bars_of_group
from ..mesh.exchange import GhostExchange, Router
from ..mesh.slab import slab_of, slab_range
from ..output.units import engineering
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from .bar_springs import PairLaw, damp, damping_of, slide
from .bars_at_walls import WIDTH as BAR_WIDTH
from .bars_at_walls import BarsAtWalls
from .neighbours import (
    Points,
    Segments,
    clip,
    closest,
    find_pairs,
    largest_change,
    segment_distance,
)
from .rotations import add_to, along, dot, minus, put, times, vector
from .rows import owner_starts, to_owners

if TYPE_CHECKING:
    from ..integrators.base import Balance, Scheme
    from .node_walls import WallForces

Turns = tuple[np.ndarray, np.ndarray, np.ndarray] | None
"""See :meth:`~pfem_petsc.contact.transform.Transform.turns`."""

_CROSSED = 0.1  # largest square of the sine of the angle from which bars touch in one point
_STIFFNESS = 1.0  # of a pair, over the harmonic mean of E A/l of its bars
_SHARE = 0.2  # of the mass of a pair over the square of the step, which its stiffness does not exceed
_PART = 0.1, 0.5  # of the stiffness and damping that a node may still have, for what begins to touch it in a step
_ROOM = 0.6  # least sum of squared frequencies that a step must leave for contacts, over its inverse square
_SKIN = 0.1, 0.5  # least and largest distance beyond the radii up to which pairs are listed, over the length of bars
_STEPS = 20.0  # steps for which the skin should be sufficient, unless it is too large then
_FEW, _MANY = 0.1, 0.6  # pairs for each bar in lists that are made with a larger or a smaller skin the next time
_CLOSER = 0.2  # of the distance of a pair, up to which an iteration may reduce it
_ADVANCES = 100  # parts of the way of a pair in an iteration, at the end of which the rest is left for the next
_TINY = 1e-30  # imaginary part of a position [m], whose square vanishes beside one
_STILL = 1e-10  # change of squared distances in a step, over that of the radii, below which energies are rounding
_WIDER = 1.05  # bound of the next displacements over the largest one
_LEAST = 0.25  # distance in the mesh, over the sum of radii, below which bars cross there and do not touch
_DEEP = 0.2  # overlap over the radius from which results are doubtful
_GAIN = 0.1  # energy that dampers produce, over what is stored or dissipated, from which results are doubtful
_TAG = 7800  # of messages between ranks with nodes of the same pairs

NORMAL, SPRING, VISCOUS, FIRST, SECOND, WIDTH = 0, 3, 6, 7, 8, 9
"""Columns of the memory of a pair: unit normal from the first bar to the second; elastic part of their slip [m]; normal
force of the damper [N]; where they touch, from 0 to 1 on each; and their number."""

APART, TOUCHING, BEGINNING = range(3)
"""States of pairs."""


class PairArrays(NamedTuple):
    """Pairs of bars (m), ascending by their numbers.

    Attributes
    ----------
    ends : (m, 4) ends of the first bar and of the second, rows of :class:`NodeArrays`
    reach, crossed : (m,) sum of radii, or less [m]; square of the sine of the angle from which bars cross
    most : (m,) stiffness that they would have alone [N/m]
    counted : (m,) bool, whether sums of this rank include it
    stiffness, drag : (m,) of those that touch [N/m], and their largest damping [N s/m]
    wake : (m,) way of the nodes at which it may touch [m]
    """

    ends: np.ndarray
    reach: np.ndarray
    crossed: np.ndarray
    most: np.ndarray
    counted: np.ndarray
    stiffness: np.ndarray
    drag: np.ndarray
    wake: np.ndarray


class NodeArrays(NamedTuple):
    """Nodes of pairs: ``x`` (q, 6) positions and displacements in the step [m]; ``inverse`` (q,) of the masses [1/kg],
    zero for nodes that supports hold; ``force`` (q, 3) internal forces [N]."""

    x: np.ndarray
    inverse: np.ndarray
    force: np.ndarray


Look = tuple[NodeArrays | None, np.ndarray | None, PairLaw]

ENERGY, DISSIPATED, CONTACTS, OVERLAP, FORCE, DEPTH = range(6)
"""Sums over the counted pairs: stored energy, and that dissipated in the step [J]; how many touch. Largest overlap [m],
force [N], and overlap over the radius."""


@inlined
def _gradient(g, s, t, force):
    """Add the gradient (4, 3) of the energy by a ``force`` between points of the bars."""
    add_to(g, 0, 1.0 - s, force)
    add_to(g, 1, s, force)
    add_to(g, 2, t - 1.0, force)
    add_to(g, 3, -t, force)


@inlined
def _way(x, ends, s, t):
    """Return the way from a point of the first bar to one of the second, or the difference of their displacements."""
    first, second = vector(x, ends[0]), vector(x, ends[2])
    first = along(first, s, minus(vector(x, ends[1]), first))
    return minus(along(second, t, minus(vector(x, ends[3]), second)), first)


@inlined
def _repel(pairs, p, x, s, t, g):
    """Write the gradient ``g`` (4, 3) of the energy of a pair that touches at ``s`` and ``t``; return the energy, the
    sum of the forces, and their mean points."""
    ends, k, reach = pairs.ends[p], pairs.stiffness[p], pairs.reach[p]
    u, v = minus(vector(x, ends[1]), vector(x, ends[0])), minus(vector(x, ends[3]), vector(x, ends[2]))
    uu, vv, uv = dot(u, u), dot(v, v), dot(u, v)
    q = clip((1.0 - uv * uv / (uu * vv)) / pairs.crossed[p]) if (uu * vv).real > 0.0 else 0.0
    m = q * q * q * (10.0 - q * (15.0 - 6.0 * q))
    energy = push = at = other = 0.0
    excess = 0.0  # of the energy where bars cross over that where they are parallel
    g[:] = 0.0
    for j in range(5 if m.real < 1.0 else 1):
        weight = m if j == 0 else 0.5 * (1.0 - m)
        if j == 1 or j == 2:
            s = j - 1.0
            t = closest((0.0, 0.0, 0.0), v, minus(vector(x, ends[j - 1]), vector(x, ends[2])))[1]
        elif j > 2:
            t = j - 3.0
            s = closest((0.0, 0.0, 0.0), u, minus(vector(x, ends[j - 1]), vector(x, ends[0])))[1]
        way = _way(x, ends, s, t)
        d = np.sqrt(dot(way, way))
        overlap = reach - d
        if not overlap.real > 0.0:
            continue
        excess += 0.5 * k * overlap * overlap * (1.0 if j == 0 else -0.5)
        if weight == 0.0:
            continue
        force = weight * k * overlap
        energy += 0.5 * force * overlap
        push += force
        at += force * s
        other += force * t
        if d.real > 0.0:
            _gradient(g, s, t, times(force / d, way))
    if 0.0 < q.real < 1.0:
        slope = excess * 30.0 * q * q * (1.0 - q) * (1.0 - q) / pairs.crossed[p] * -2.0 * uv / (uu * vv)
        for i in range(2):
            add_to(g, i, slope * (2.0 * i - 1.0), along(v, -uv / uu, u))
            add_to(g, 2 + i, slope * (2.0 * i - 1.0), along(u, -uv / vv, v))
    return energy, push, at, other


@inlined
def _farthest_move(x, ends):
    """Return the square of the largest difference of the displacements of ends of both bars."""
    farthest = 0.0
    for i in range(4):
        moved = minus(vector(x, ends[2 + i % 2]), vector(x, ends[i // 2]))
        farthest = max(farthest, dot(moved, moved))
    return farthest


@kernel
def find_beginning(pairs, state, memory, nodes, law, load):
    """Find the pairs that begin to touch, and what the nodes of all pairs carry; pairs may sleep meanwhile.

    ``pairs``: PairArrays; ``state`` (m,): states, of which some become :data:`BEGINNING`; ``memory`` (m, width);
    ``nodes``: NodeArrays; ``law``: PairLaw; ``load`` (q, 3): sums over the pairs of a node, times its weight, of their
    stiffness [N/m] and largest damping [N s/m], and of 1 for those that begin. Returns how many begin, 1 plus the pair
    that moves too far in a step, or 0, and the way at which another may touch [m], if none does.
    """
    x, ends = nodes.x, pairs.ends
    segments = ends.reshape(-1, 2)
    beginning, failed, asleep = 0, 0, np.inf
    for p in range(len(ends)):
        touches = state[p] == TOUCHING
        if not touches:
            if pairs.wake[p] > law.way:
                asleep = min(asleep, pairs.wake[p])
                continue
            d, s, t = segment_distance(x, segments, 2 * p, 2 * p + 1)
            farthest = _farthest_move(x[:, 3:], ends[p])
            if farthest > 0.25 * pairs.reach[p] ** 2 and d < pairs.reach[p] + np.sqrt(farthest):
                failed = 1 + p
            if not d < pairs.reach[p]:
                pairs.wake[p] = law.base + (d - pairs.reach[p])
                asleep = min(asleep, pairs.wake[p])
                continue
            beginning += 1
            state[p], pairs.wake[p] = BEGINNING, 0.0
            memory[p, :] = 0.0
            memory[p, FIRST], memory[p, SECOND] = s, t
        asleep = 0.0
        for i in range(4):
            at = memory[p, FIRST if i < 2 else SECOND]
            weight = at if i % 2 == 1 else 1.0 - at
            if touches:
                load[ends[p, i], 0] += weight * pairs.stiffness[p]
                load[ends[p, i], 1] += weight * pairs.drag[p]
            else:
                load[ends[p, i], 2] += weight
    return beginning, failed, asleep


@kernel
def evaluate_pairs(pairs, state, old, new, nodes, law, out):
    """Compute forces and sums of the pairs that touch, and their memory ``new`` (m, width) from the ``old`` one.

    ``pairs``: PairArrays; ``state`` (m,), which is changed; ``nodes``: NodeArrays, to whose forces those of pairs are
    added; ``law``: PairLaw; ``out`` (6,): sums from :data:`ENERGY` on. Returns 1 plus the pair that has passed through
    itself, or 0. Positions, forces, new memory and sums may be complex, with derivatives as imaginary parts.
    """
    x, failed, g, segments = nodes.x, 0, np.zeros((4, 3), nodes.force.dtype), pairs.ends.reshape(-1, 2)
    for p in range(len(pairs.ends)):
        if state[p] == APART:
            continue
        ends = pairs.ends[p]
        d, s, t = segment_distance(x, segments, 2 * p, 2 * p + 1)
        k, reach = pairs.stiffness[p], pairs.reach[p]
        energy = push = at = other = lost = 0.0
        if d.real < reach:
            energy, push, at, other = _repel(pairs, p, x, s, t, g)
        if push.real > 0.0:
            s, t = at / push, other / push
        way, before = _way(x[:, 3:], ends, s, t), vector(old[:, NORMAL:], p)
        if push.real <= 0.0:  # what spring and damper held is lost
            spring = vector(old[:, SPRING:], p)
            lost = 0.5 * k * dot(spring, spring) - 0.5 * old[p, VISCOUS] * dot(way, before)
            state[p] = APART
            if pairs.counted[p]:
                out[DISSIPATED] += lost
            continue
        between = _way(x, ends, s, t)
        apart, held = np.sqrt(dot(between, between)), 0.0
        normal = times(1.0 / apart if apart.real > 0.0 else 0.0, between)
        closing, end = dot(normal, way), times(0.0, normal)
        if apart.real <= 0.0 or (state[p] == TOUCHING and dot(normal, before).real < 0.0):
            failed = 1 + p
        mobility = (1.0 - s) ** 2 * nodes.inverse[ends[0]] + s**2 * nodes.inverse[ends[1]]
        mobility += (1.0 - t) ** 2 * nodes.inverse[ends[2]] + t**2 * nodes.inverse[ends[3]]
        total = push
        if law.lead > 0.0 or state[p] == TOUCHING:
            # the damper of a pair that begins to touch would jump: a step that ends just there had no solution
            total = damp(push, k, closing, mobility, law, pairs.drag[p])
        lost -= 0.5 * (old[p, VISCOUS] + total - push) * closing
        if total != push:
            _gradient(g, s, t, times(total - push, normal))
        if law.friction > 0.0:
            end, held, rubbed = slide(vector(old[:, SPRING:], p), k, law.friction * total / k, way, normal)
            lost += rubbed
            _gradient(g, s, t, times(-k, end))
        state[p] = TOUCHING
        new[p, VISCOUS], new[p, FIRST], new[p, SECOND] = total - push, s, t
        put(new[:, NORMAL:], p, normal)
        put(new[:, SPRING:], p, end)
        for i in range(4):
            add_to(nodes.force, ends[i], 1.0, vector(g, i))
        if pairs.counted[p]:
            out[ENERGY] += energy + held
            out[DISSIPATED] += lost
            out[CONTACTS] += 1.0
            out[OVERLAP] = max(out[OVERLAP].real, reach - d.real)
            out[FORCE] = max(out[FORCE].real, np.sqrt((total * total + 2.0 * k * held).real))
            out[DEPTH] = max(out[DEPTH].real, 2.0 * (reach - d.real) / reach)
    return failed


@inlined
def _energy_before(pair, nodes, part, place, g):
    """Write the gradient of the energy of a pair alone, a ``part`` of the step before its end, with the ``place``
    (4, 3) of its nodes; return the energy."""
    g[:] = 0.0
    for i in range(4):
        put(place, i, along(vector(nodes.x, i), -part, vector(nodes.x[:, 3:], i)))
    d, s, t = segment_distance(place, pair.ends.reshape(-1, 2), 0, 1)
    return _repel(pair, 0, place, s, t, g)[0] if d.real < pair.reach[0] else 0.0 * d


@inlined
def _change(place, x, i, j):
    """Return half of the change of the squared distance of two ends, with the middle of their ways as ``place``, and
    the way between them there."""
    between = minus(vector(place, i), vector(place, j))
    return dot(between, minus(vector(x[:, 3:], i), vector(x[:, 3:], j))), between


@inlined
def _step_gradient(pair, nodes, place, g):
    """Write the discrete gradient of the energy of a pair alone, whose work in the step is the change of the energy.

    It is the gradient in the middle of the step and a correction along those of the squared distances of its four
    ends (Gonzalez, 1996): forces along the lines between them, which keep momentum and angular momentum.
    """
    missing = _energy_before(pair, nodes, 0.0, place, g) - _energy_before(pair, nodes, 1.0, place, g)
    _energy_before(pair, nodes, 0.5, place, g)
    square = 0.0 * missing
    for i in range(4):
        missing -= dot(vector(g, i), vector(nodes.x[:, 3:], i))
        for j in range(i):
            square += _change(place, nodes.x, i, j)[0] ** 2
    if square.real > (_STILL * pair.reach[0] ** 2) ** 2:
        for i in range(4):
            for j in range(i):
                change, between = _change(place, nodes.x, i, j)
                add_to(g, i, missing / square * change, between)
                add_to(g, j, -missing / square * change, between)


@inlined
def _take_pair(pairs, p, nodes, own):
    """Return a pair alone, and copy its nodes to ``own``, of four nodes, without forces."""
    ends, one = np.arange(4).reshape(1, 4), slice(p, p + 1)
    for i in range(4):
        own.inverse[i] = nodes.inverse[pairs.ends[p, i]]
        own.x[i, :] = nodes.x[pairs.ends[p, i]]
    sizes = pairs.reach[one], pairs.crossed[one], pairs.most[one], pairs.counted[one]
    return PairArrays(ends, *sizes, pairs.stiffness[one], pairs.drag[one], pairs.wake[one])


@kernel
def add_step_gradients(pairs, state, nodes):
    """Add the discrete gradients of a step of the pairs that touch to the forces of the nodes.

    ``pairs``: PairArrays; ``state`` (m,); ``nodes``: NodeArrays at the end of the step, see :func:`_step_gradient`.
    Positions and forces may be complex, with derivatives as imaginary parts.
    """
    kind = nodes.force.dtype
    own = NodeArrays(np.zeros((4, 6), kind), np.zeros(4), np.zeros((4, 3), kind))
    place, g = np.zeros((4, 3), kind), np.zeros((4, 3), kind)
    for p in range(len(pairs.ends)):
        if state[p] == APART:
            continue
        _step_gradient(_take_pair(pairs, p, nodes, own), own, place, g)
        for i in range(4):
            add_to(nodes.force, pairs.ends[p, i], 1.0, vector(g, i))


@kernel
def differentiate_pairs(pairs, states, old, nodes, law, whole, blocks):
    """Write the derivatives (k, 12, 12) of the forces of the pairs (m,) that by their ``states`` (m,) are not apart, by
    the positions of their ends, those of discrete gradients if ``whole``; the other arguments as for
    :func:`evaluate_pairs`.

    The force is evaluated at positions with a tiny imaginary part, that of which is the derivative to rounding, as
    nothing is subtracted (Squire and Trapp, 1998): of everything that depends on the positions, such as where bars
    touch, blends, and the slip.
    """
    new, out, state = np.zeros((1, old.shape[1]), np.complex128), np.zeros(6, np.complex128), np.zeros(1, np.uint8)
    own = NodeArrays(np.zeros((4, 6), np.complex128), np.zeros(4), np.zeros((4, 3), np.complex128))
    chosen = np.flatnonzero(states != APART)
    for k in range(len(chosen)):
        p = chosen[k]
        for column in range(12):
            pair = _take_pair(pairs, p, nodes, own)
            own.x[column // 3, column % 3] += 1j * _TINY
            own.x[column // 3, 3 + column % 3] += 1j * _TINY
            state[0], own.force[:] = states[p], 0.0
            if whole:
                add_step_gradients(pair, state, own)
            else:
                evaluate_pairs(pair, state, old[p : p + 1], new, own, law, out)
            for row in range(12):
                blocks[k, row, column] = own.force[row // 3, row % 3].imag / _TINY


@kernel
def free_part(pairs, x, way):
    """Return the largest part of the ways (q, 3) of nodes from ``x`` (q, 3) on which no pair comes closer than
    :data:`_CLOSER` of its distance there, or of its reach, and 1 plus the pair that limits it, or 0.

    Distances change by at most the largest relative way (conservative advancement; Li et al., 2021).
    """
    segments, place, part, limiting = np.arange(4).reshape(2, 2), np.zeros((4, 3)), 1.0, 0
    for p in range(len(pairs.ends)):
        ends, at, least, free = pairs.ends[p], 0.0, -1.0, False
        most = np.sqrt(_farthest_move(way, ends))
        for _ in range(_ADVANCES):
            for i in range(4):
                put(place, i, along(vector(x, ends[i]), at, vector(way, ends[i])))
            d, _, _ = segment_distance(place, segments, 0, 1)
            if least < 0.0:
                least = _CLOSER * min(d, pairs.reach[p])
            elif d < least:
                break
            free = d - 0.5 * least >= (part - at) * most
            if free:
                break
            at += (d - 0.5 * least) / most
        if not free:
            part, limiting = at, 1 + p
    return part, limiting


@kernel
def measure_pairs(nodes, ends, bars, sizes):
    """Write the sizes of pairs in the mesh (4, m): reach [m], 0 for bars that cross there; square of the sine of the
    angle from which they cross; stiffness [N/m]; and mass [kg].

    ``nodes`` (q, 4 or more): positions [m] and masses [kg]; ``ends`` (m, 4); ``bars`` (m, 4): radius and stiffness of
    both bars.
    """
    segments = ends.reshape(-1, 2)
    for p in range(len(ends)):
        apart, _, _ = segment_distance(nodes, segments, 2 * p, 2 * p + 1)
        radii, shorter, flexible, light = bars[p, 0] + bars[p, 2], np.inf, 0.0, 0.0
        for i in range(2):
            a, b = ends[p, 2 * i], ends[p, 2 * i + 1]
            way = minus(vector(nodes, b), vector(nodes, a))
            shorter = min(shorter, dot(way, way))
            flexible += 1.0 / bars[p, 2 * i + 1]
            light += 1.0 / min(nodes[a, 3], nodes[b, 3])
        reach = min(radii, apart)
        sizes[0, p] = reach if reach > _LEAST * radii else 0.0
        sizes[1, p] = min(_CROSSED, reach * reach / shorter)
        sizes[2, p] = 2.0 * _STIFFNESS / flexible
        sizes[3, p] = 1.0 / light


@inlined
def _moved(row, before, i):
    """Return an element of ``row`` (n,), less that of ``before`` (n,), zero if that is None."""
    if before is None:
        return row[i]
    return row[i] - before[i]


@inlined
def _component(vectors, c):
    """Return a row of vectors (3, n), or None if these are."""
    if vectors is None:
        return None
    return vectors[c]


@kernel
def largest_move(rows, last, drift, most):
    """Return a distance that no node with the coordinates ``rows`` (3, n) is farther from last (3, n) + drift (3,)
    than, where None stands for ``last`` at zero; infinite for positions that are not finite. ``most`` (3,): bounds of
    the components in the last call, which are found anew where they are too small: comparisons are quicker than
    maxima. Of velocities, it is a bound relative to a drift."""
    square = 0.0
    for c in range(3):
        row, before, shift, limit = rows[c], _component(last, c), drift[c], most[c]
        beyond = 0
        for i in range(len(row)):
            beyond += 0 if abs(_moved(row, before, i) - shift) <= limit else 1
        if beyond > 0:
            largest, total = 0.0, 0.0
            for i in range(len(row)):
                d = _moved(row, before, i) - shift
                total = add_freely(total, d)
                largest = max(largest, abs(d))
            if not np.isfinite(total):
                return np.inf
            most[c] = _WIDER * largest
        square += most[c] * most[c]
    return np.sqrt(square)


@kernel
def read_nodes(rows, x, last):
    """Return positions x (n or more, 3) and displacements since last (3, n) of some nodes (k,), see
    :class:`NodeArrays`."""
    nodes = np.empty((len(rows), 6))
    for k in range(len(rows)):
        at = vector(x, rows[k])
        put(nodes, k, at)
        put(nodes[:, 3:], k, minus(at, vector(last.T, rows[k])))
    return nodes


@kernel
def add_to_nodes(local, own, force, f):
    """Add forces (q, 3), of the nodes that are ``own`` (q,) bool, to those of the ``local`` (k,) nodes of f (n, 3)."""
    k = 0
    for i in range(len(own)):
        if own[i]:
            add_to(f, local[k], 1.0, vector(force, i))
            k += 1


class SelfContact:
    """Contact of bars with bars, whose forces are added to those of bars. Construction is collective.

    Parameters
    ----------
    model : Model, whose case has ``[self_contact]``; with masses and supports

    Attributes
    ----------
    chosen : (bars,) bool, local bars that touch others
    room : sum of squared frequencies that the step leaves for contacts [1/s2]
    at_walls : BarsAtWalls, of walls that bars can cross between their nodes, or None
    dissipated : energy that this rank's counted pairs have lost [J]
    sums : (6,) of the last forces, see :data:`ENERGY`
    deepest : largest overlap so far over the radius
    stale : whether bars have left the model since the last search
    implicit : whether steps solve equations
    between : the last bars, or bar and wall, that would have passed through each other in an iteration of such a step,
        empty for none

    Raises
    ------
    InputError
        On all ranks, for a group of bars that the mesh does not have.
    """

    energies = ("self_contact_energy", "self_contact_dissipation")

    def __init__(self, model: Any) -> None:
        self._model, self._mesh, self.comm = model, model.mesh, model.comm
        table, mesh, comm = model.case.self_contact, model.mesh, model.comm
        if model.case.time is None and model.case.static is None:
            raise InputError(f"{model.case.source}: [self_contact] needs steps: [time], or [static]")
        with agreed(comm):
            chosen = np.ones(len(mesh.bars), dtype=bool)
            if table.bars is not None:
                chosen[:] = False
                chosen[bars_of_group(model.case, mesh, "self_contact.bars", str(table.bars))] = True
        chosen &= mesh.bar_ids < mesh.n_bars - mesh.n_connectors
        self.chosen, self._bars = chosen, np.arange(len(mesh.bars), dtype=np.int32)[mesh.counted]
        self._bars = self._bars[chosen[self._bars]]
        self._radius = model.bars.radii() if table.radius is None else np.full(len(mesh.bars), float(table.radius))
        lengths = model.bars.mesh_lengths[self._bars]
        sums = comm.allreduce(np.array([lengths.sum(), len(lengths)]))
        self._thick = 2.0 * comm.allreduce(float(self._radius[self._bars].max(initial=0.0)), op=MPI.MAX)
        self._mean, self._listed = float(sums[0] / max(sums[1], 1.0)), -1.0
        self._skin = 2.0 * _SKIN[0] * self._mean
        if self._thick > self._mean > 0.0:
            model.warnings.append(
                f"[self_contact]: bars are up to {self._thick:.3g} m thick and {self._mean:.3g} m long on average; "
                "those that are closer in the mesh than a quarter of the thickness do not touch: correct "
                "self_contact.radius [m], or the area of the section, if it is in another unit"
            )
        self._friction, self._damping = float(table.friction), damping_of(float(table.restitution))
        self._starts = owner_starts(mesh)
        self._numbers = np.concatenate([mesh.first_node + np.arange(mesh.n_owned), mesh.ghost_numbers])
        # ends, radius and stiffness of all bars on the ranks of their slabs
        ids = mesh.bar_ids[self._bars].astype(np.int64)
        router = Router(comm, slab_of(ids, mesh.n_bars, comm.size))
        self._first_bar, end = slab_range(mesh.n_bars, comm.rank, comm.size)
        self._directory, at = np.zeros((end - self._first_bar, 4)), router.send(ids) - self._first_bar
        ends, stiffness = self._numbers[mesh.bars[self._bars]], model.bars.stiffness[self._bars]
        self._directory[at] = router.send(np.column_stack([ends, self._radius[self._bars], stiffness]))
        self._h, self.room, self.implicit, self._steps = 0.0, 0.0, False, "time.step"
        self.between = ""
        self.dissipated, self.deepest, self.stale = 0.0, 0.0, False
        self.sums = np.zeros(6)
        self._wall_energies = np.zeros(3)  # of bars that touch: most stored at once; lost, and gained, in steps [J]
        self._way, self._limit, self._drift, self._most = 0.0, 0.0, np.zeros(3), np.zeros(3)
        self._reference = mesh.points[: mesh.n_owned].copy()
        self._last = self._reference.T.copy()
        self._exchange: GhostExchange | None = None
        self._empty()
        made = BarsAtWalls(model, chosen)
        self.at_walls = made if made.walls else None

    def begin(self, scheme: Scheme, h: float, frequency: float, critical: float) -> None:
        """Take the step [s], the highest frequency of the bars [rad/s] and the critical step [s].

        Raises
        ------
        InputError
            If the step leaves no room for the stiffness of contacts.
        """
        source, self._h = self._model.case.source, h
        if not scheme.explicit:
            self.begin_implicit(scheme)
            return
        if self._model.inertia.redistribution is not None or self._model.inertia.consistent:
            raise InputError(
                f'{source}: [self_contact] needs time.mass = "lumped", and no contact.treatment = "mass_redistribution"'
            )
        # less a tenth, as weights change
        room = 0.9 * (frequency * h) ** 2 * ((critical / h) ** 2 - 1.0) if np.isfinite(critical) else 1.0
        if room < _ROOM:
            raise InputError(
                f"{source}: time.step = {h:g} s leaves no room for the stiffness of [self_contact] below the critical "
                f"step of {critical:.6g} s; use at most {0.9 * critical:.6g} s"
            )
        self.room = room / (h * h)

    def begin_implicit(self, scheme: Scheme) -> None:
        """Take a scheme whose steps solve equations; stiffness is not limited then. Collective.

        Raises
        ------
        InputError
            For what such steps do not serve.
        """
        case, self._h, self.implicit = self._model.case, 0.0, True
        self._steps = "time.step" if scheme.inertial else "static.step"
        static = "newton" if case.static is None else case.static.method
        scheme_name = "" if case.time is None else case.time.integrator
        walls = [] if self.at_walls is None else [repr(self._model.contact.names[k]) for k in self.at_walls.walls]
        conserves = "it conserves energy: use another one, or remove friction and restitution"
        for applies, what, remedy in (
            (static != "newton", f'static.method = "{static}"', 'use "newton"'),
            (
                case.modes is not None,
                "[modes]",
                "their stiffness has no contact: give the table to the stages before only",
            ),
            (
                walls and scheme.discrete_gradient,
                f"walls {', '.join(walls)}, which bars touch between their nodes, with time.integrator = "
                f'"{scheme_name}"',
                "use another integrator",
            ),
            (scheme.discrete_gradient and not self.symmetric, f'time.integrator = "{scheme_name}"', conserves),
        ):
            if applies:
                raise InputError(
                    f"{case.source}: [self_contact] does not serve {what} in implicit or static steps; {remedy}"
                )

    def operator(self) -> str:
        """Return ``solver.operator``: the matrix has the pairs that touch in its pattern.

        Raises
        ------
        InputError
            If the case asks for another one.
        """
        source, asked = self._model.case.source, self._model.case.solver
        if asked.operator == "matrix_free" or asked.linear == "multigrid":
            key = 'operator = "matrix_free"' if asked.operator == "matrix_free" else 'linear = "multigrid"'
            raise InputError(f'{source}: solver.{key}: [self_contact] needs a matrix; use "auto"')
        return "assembled"

    @property
    def symmetric(self) -> bool:
        """Whether the derivative of the forces is symmetric: without friction and damping."""
        alone = self.at_walls is None or not (self.at_walls.rubs or self.at_walls.damped)
        return alone and not self._friction and not self._damping

    @property
    def touches(self) -> bool:
        """Whether bars of this rank touch others or, between their nodes, walls."""
        return self.sums[CONTACTS] > 0.0 or (self.at_walls is not None and self.at_walls.touches)

    def begin_solve(self, time: float) -> None:
        """Take the time of the positions that are tried from now on [s]."""
        self.between = ""
        if self.at_walls is not None:
            self.at_walls.time = time

    def text(self) -> str:
        """Return what can touch, for the user before a run. Collective."""
        return f"{self.comm.allreduce(len(self._bars)):,} bars, up to {engineering(self._thick, 'm')} thick"

    def doubts(self) -> list[str]:
        """Return a text if bars have overlapped deeply. Collective."""
        deepest = self.comm.allreduce(self.deepest, op=MPI.MAX)
        text = (
            f"[self_contact]: bars have overlapped by up to {100.0 * deepest:.0f} % of a radius, as contacts must be "
            "soft for this time.step: a smaller one (time.safety) makes them stiffer"
        )
        told = [text] if deepest > _DEEP else []
        most, lost, gained = self.comm.allreduce(self._wall_energies)
        if gained > _GAIN * max(most, lost):
            told.append(
                f"[self_contact]: dampers of bars at walls have produced {gained:.3g} J in some steps, and dissipated "
                f"{lost:.3g} J in others: a smaller {self._steps} follows their impacts"
            )
        return told

    def hint(self) -> str:
        """Return what to add to the message about a solve that did not converge. Collective."""
        depth = self.comm.allreduce(float(self.sums[DEPTH]), op=MPI.MAX)
        self.between = max(self.comm.allgather(self.between))
        if self.between:
            return f". {self.between[0].upper()}{self.between[1:]} would have passed through each other in an iteration"
        return f". Bars overlap by {100.0 * depth:.0f} % of a radius" if depth > _DEEP else ""

    # pairs

    def _search(self, x: np.ndarray, move: float) -> None:
        """Make the list of pairs at positions (local, 3); nodes ``move`` in a step [m]. Collective.

        The skin grows as long as few pairs are listed, and shrinks where they are many.
        """
        bars, model = self._bars, self._model
        if self._listed >= 0.0:
            factor = 2.0 if self._listed < _FEW else 0.7 if self._listed > _MANY else 1.0
            self._skin = min(max(self._skin * factor, _SKIN[0] * self._mean), _SKIN[1] * self._mean)
            self._skin = max(self._skin, min(_STEPS * move, _SKIN[1] * self._mean))
        self._skin = max(self._skin, 4.0 * move)
        if model.bars.can_break:
            bars = bars[model.bars.status()[bars] != STATUS.index("broken")]
        margin = self._radius[bars] + 0.5 * self._skin
        segments = Segments(self._mesh.bar_ids[bars].astype(np.int64), self._mesh.bars[bars], margin)
        found = find_pairs(self.comm, Points(np.ascontiguousarray(x), self._numbers), segments)
        if found is None:
            raise SimulationFailure(
                "[self_contact]: too many bars are in one place to find those that touch: reduce self_contact.radius, "
                "or choose fewer bars with self_contact.bars"
            )
        number, listed = self.comm.allreduce(np.array([len(bars), len(found.ids)]))
        self._listed = listed / max(number, 1)
        self._install(found.ids.astype(np.int64))

    def _of_bars(self, ids: np.ndarray) -> np.ndarray:
        """Return ends, radius and stiffness (n, 4) of bars by their numbers (n,). Collective."""
        wanted, place = np.unique(ids, return_inverse=True)
        asking = Router(self.comm, slab_of(wanted, self._mesh.n_bars, self.comm.size))
        return asking.reply(self._directory[asking.send(wanted) - self._first_bar])[place.ravel()]

    def _empty(self) -> None:
        """Begin without pairs that touch; they are searched at the next evaluation."""
        self._asleep = 0.0
        self._keys, self._touching, self._limit = np.empty(0, dtype=np.int64), np.empty((0, WIDTH + 2)), 0.0
        self._state = np.empty(0, dtype=np.uint8)

    def _touches(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of both bars, as one (m,), of the pairs that touch here, and memory, stiffness and largest
        damping (m, width + 2) of each."""
        if not len(self._state):
            return self._keys, self._touching
        touch, pairs = self._state == TOUCHING, self._pairs
        return self._keys[touch], np.column_stack([self._memory, pairs.stiffness, pairs.drag])[touch]

    def _install(self, ids: np.ndarray) -> None:
        """Take pairs of bars (m, 2) from any ranks. Those that touch stay so. Collective."""
        self._asleep = 0.0
        comm, mesh, starts = self.comm, self._mesh, self._starts
        kept, of_bars = self._touches(), self._of_bars(ids.ravel()).reshape(-1, 2, 4)
        ends, sizes = of_bars[:, :, :2].astype(np.int64).reshape(-1, 4), of_bars[:, :, 2:].reshape(-1, 4)
        rows = np.hstack([ids, ends, np.ascontiguousarray(sizes).view(np.int64)])
        rows = to_owners(rows, range(2, 6), starts, comm)
        ids, ends, sizes = rows[:, :2], rows[:, 2:6], np.ascontiguousarray(rows[:, 6:]).view(np.float64)
        numbers, places = np.unique(ends, return_inverse=True)
        self._own = own = (numbers >= starts[comm.rank]) & (numbers < starts[comm.rank + 1])
        self._at, ends = numbers, places.reshape(-1, 4)
        self._local = (numbers[own] - starts[comm.rank]).astype(np.int64)
        if self._exchange is not None:
            self._exchange.close()
        self._exchange = GhostExchange(comm, starts, numbers[~own], _TAG)
        mass = self._model.inertia.mass
        inverse = np.where(self._model.supports.fixed.all(axis=1), 0.0, 1.0 / mass)
        of_nodes = np.column_stack([mesh.points[: mesh.n_owned], mass, inverse])
        of_nodes = self._gather(of_nodes.__getitem__, 5)
        measures = np.empty((4, len(ends)))
        measure_pairs(of_nodes, ends, np.ascontiguousarray(sizes), measures)
        reach, crossed, most, inertia = measures
        if self._h:
            np.minimum(most, _SHARE / self._h**2 * inertia, out=most)
        used = np.flatnonzero((reach > 0.0) & (most > 0.0))
        self.ids, ends, n = ids[used], ends[used], len(used)
        self._keys, self._state = self.ids[:, 0] * mesh.n_bars + self.ids[:, 1], np.full(n, APART, dtype=np.uint8)
        memory = np.zeros((n, WIDTH + 2))
        stays = np.isin(kept[0], self._keys)  # not those of bars that have left the model
        place = np.searchsorted(self._keys, kept[0][stays])
        memory[place], self._state[place], self._touching = kept[1][stays], TOUCHING, kept[1][:0]
        self._memory, self._spare = np.ascontiguousarray(memory[:, :WIDTH]), np.zeros((n, WIDTH))
        counted = self._own[ends[:, 0]] if n else np.empty(0, dtype=bool)
        varying = memory[:, WIDTH].copy(), memory[:, WIDTH + 1].copy(), np.zeros(n)
        self._pairs = PairArrays(ends, reach[used], crossed[used], most[used], counted, *varying)
        self._mass, self._inverse = of_nodes[:, 3].copy(), of_nodes[:, 4].copy()

    def _stiffen(self, state: np.ndarray, load: np.ndarray) -> None:
        """Give pairs that begin to touch their stiffness and largest damping, with what the nodes (q, 3) carry, see
        :func:`find_beginning`. Collective."""
        pairs, begin = self._pairs, np.flatnonzero(state == BEGINNING)
        pairs.stiffness[begin], pairs.drag[begin] = pairs.most[begin], inf
        if not self._h:
            return
        if self.comm.size > 1:
            owned = np.zeros((self._mesh.n_owned, 3))
            owned[self._local] = load[self._own]
            load = self._gather(owned.__getitem__, 3)
        ends = pairs.ends[begin]
        room = self._mass[ends][:, :, None] * np.array([0.5 * self.room, 0.5 / self._h])
        load = load[ends]
        left = np.array(_PART) * np.maximum(room - load[:, :, :2], 0.0) / np.maximum(load[:, :, 2:], 1e-6)
        least = left.min(axis=1, initial=inf)
        pairs.stiffness[begin] = np.minimum(pairs.most[begin], least[:, 0])
        pairs.drag[begin] = least[:, 1]

    def _gather(self, values_of: Callable[[np.ndarray], np.ndarray], width: int) -> np.ndarray:
        """Return values (q, width) at the nodes of pairs; ``values_of`` gives those of owned nodes (k,). Collective."""
        if self.comm.size == 1:
            return values_of(self._local)
        values = np.empty((len(self._own), width))
        values[self._own] = values_of(self._local)
        values[~self._own] = self._exchange.bring(values_of(self._exchange.rows))
        return values

    # steps

    def add_forces(self, x: np.ndarray, f: np.ndarray, commit: bool) -> tuple[float, float]:
        """Add the forces at positions ``x`` to ``f``, see :meth:`evaluate`, in a step of the bars."""
        return self.evaluate(x, f, self._step, commit)

    @property
    def _step(self) -> float:
        """The step of the bars [s], zero where no time passes."""
        step = self._model.bars.step
        return step if step < np.inf else 0.0

    def evaluate(self, x: np.ndarray, f: np.ndarray, step: float, commit: bool) -> tuple[float, float]:
        """Add the forces of bars at positions ``x``, a ``step`` [s] after the last that were committed, to ``f``, both
        (local, 3), with those of walls between nodes; return the stored energy and all that is dissipated [J].
        Collective.

        Forces that are not a number stand for bars of a trial that have passed through each other.

        Raises
        ------
        SimulationFailure
            On all ranks, if a bar has passed through another, or may have.
        """
        found, sums = self._look(x, step, commit), np.zeros(6)
        if found is None:
            return float(self.sums[ENERGY]), self.dissipated
        arrays, state, law = found
        unprevented = (
            f", which the stiffness of [self_contact] did not prevent: reduce {self._steps}, or use more elements, a "
            "larger self_contact.radius or lower velocities"
        )
        if state is not None:
            passed = evaluate_pairs(self._pairs, state, self._memory, self._spare, arrays, law, sums)
            if self.implicit and not commit:
                arrays.force[:] = np.nan if passed else arrays.force
            else:
                self._report(passed, f" pass through each other{unprevented}")
            add_to_nodes(self._local, self._own, arrays.force, f)
        if commit:
            self._memory, self._spare = self._spare, self._memory
            self._way, self.sums, self._last[:] = law.way, sums, x[: self._last.shape[1]].T
            self.dissipated += float(sums[DISSIPATED])
            self.deepest = max(self.deepest, float(sums[DEPTH]))
        stored = float(sums[ENERGY])
        if self.at_walls is not None:
            if not self.implicit and commit:
                crossing = self.at_walls.crossing(x, self._model.contact.state.time)
                self._report(crossing, f" pass through each other{unprevented}")
            more, lost = self.at_walls.add_forces(x, f, step, commit)
            if not self.implicit or commit:
                self._report(self.at_walls.passed, unprevented)
            elif self.at_walls.passed:
                self.between = self.at_walls.passed.replace(" passes through ", " and ")
            stored += more
            if commit:
                self.dissipated += lost
                self._wall_energies += max(stored - self._wall_energies[0], 0.0), max(lost, 0.0), max(-lost, 0.0)
        return stored, self.dissipated

    def pushes(self, x: np.ndarray, weight: float) -> np.ndarray:
        """Return forces and moments (2, walls, 3) of walls on bars of this rank between their nodes, in a balance that
        has a ``weight`` for the forces at positions x (local, 3), and the rest for those that were committed last."""
        if self.at_walls is None:
            return np.zeros((2, len(self._model.contact.walls), 3))
        return self.at_walls.pushes(x, self._step, weight)

    def with_walls(self, walls: WallForces, x: np.ndarray, weight: float) -> WallForces:
        """Return forces of walls with the :meth:`pushes` of such a balance."""
        if self.at_walls is None:
            return walls
        force, moment = self.pushes(x, weight)
        return replace(walls, force=walls.force + force, moment=walls.moment + moment)

    def crossing(self, x: np.ndarray, time: float) -> str:
        """Return the names of a bar and a wall that have passed through each other in a step to x (local, 3) at a time
        [s], see :meth:`~pfem_petsc.contact.bars_at_walls.BarsAtWalls.crossing`. Collective."""
        return "" if self.at_walls is None else self.at_walls.crossing(x, time)

    def way_left(self) -> float:
        """Return how far bars may come closer until :meth:`evaluate` is needed again [m]: zero unless this is known on
        one rank."""
        if self.comm.size > 1 or self.at_walls is not None or self.stale or self._model.supports.moves:
            return 0.0
        return max(min(self._limit, self._asleep) - self._way, 0.0)

    @property
    def drift(self) -> np.ndarray:
        """The velocity (3,) relative to which moves are measured [m/s]."""
        return self._drift

    def pass_over(self, way: float, x: np.ndarray) -> None:
        """Take account of committed steps without contact, in which bars have come closer by at most a ``way`` [m], to
        positions (local, 3)."""
        self._way += way
        self._last[:] = x[: self._last.shape[1]].T

    def _look(self, x: np.ndarray, step: float, commit: bool) -> Look | None:
        """Return the nodes of pairs at positions (local, 3), states of the pairs, with those that begin to touch, and
        the law; only the latter if nothing touches, nor can, and None for positions that are not finite, of which other
        checks of the step tell. Collective."""
        if self.implicit:  # trials are far from each other
            self._most[:] = 0.0
        rows = tuple(np.ascontiguousarray(x[: self._last.shape[1], c]) for c in range(3))
        move = largest_move(rows, self._last, step * self._drift, self._most)
        worst = np.array([move, float(self.stale), -self._asleep])
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, worst, op=MPI.MAX)
        if not worst[0] < np.inf:
            return None
        way, self.stale = self._way + 2.0 * float(worst[0]), bool(worst[1])  # on all ranks
        if self.stale or way >= self._limit:
            self._renew(x, step, way, 2.0 * float(worst[0]))
        lead = 0.0 if self.implicit else 0.5
        law = PairLaw(self._friction, self._damping, float(step), way, way if commit else 2.0 * self._way - way, lead)
        if way < -worst[2] and self._asleep > 0.0:  # after a search, this is not known
            return None, None, law
        nodes = self._gather(lambda some: read_nodes(some, x, self._last), 6)
        arrays, load = NodeArrays(nodes, self._inverse, np.zeros((len(nodes), 3))), np.zeros((len(nodes), 3))
        state = self._state if commit else self._state.copy()
        begin, far, self._asleep = find_beginning(self._pairs, state, self._memory, arrays, law, load)
        if self._any(begin + far):
            if not self.implicit:
                self._report(
                    far,
                    ", which are about to touch, move by more than half the sum of their radii relative to each other "
                    "in a step, so that contact may miss them: reduce time.step",
                )
            self._stiffen(state, load)
        return arrays, state, law

    # steps that solve equations

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Add the discrete gradient of a step from the positions ``x0`` of the last commit to ``x``, see
        :func:`_step_gradient`, to ``f``, all (local, 3). Collective."""
        arrays, state, _ = self._look(x, self._step, False) or (None, None, None)
        if state is not None:
            add_step_gradients(self._pairs, state, arrays)
            add_to_nodes(self._local, self._own, arrays.force, f)

    def linearise(self, x: np.ndarray, balance: Balance, turns: Turns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the pairs that touch add to the Hessian of a balance at positions (local, 3), in coordinates with
        these ``turns``: owned nodes (k,), PETSc's numbers of others (k,), and blocks (k, 3, 3). Collective."""
        arrays, state, law = self._look(x, self._step, False) or (None, None, None)
        none = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3, 3))
        at_walls = none if self.at_walls is None else self._linearise_walls(x, balance, turns)
        if state is None:
            return at_walls
        chosen = np.flatnonzero(state != APART)
        ends, blocks = self._pairs.ends[chosen], np.empty((len(chosen), 12, 12))
        differentiate_pairs(self._pairs, state, self._memory, arrays, law, balance.discrete_gradient, blocks)
        if self.symmetric and not balance.discrete_gradient:
            blocks = 0.5 * (blocks + blocks.transpose(0, 2, 1))
        left, right = self._gather(self._coordinates(turns), 18).reshape(-1, 2, 3, 3).transpose(1, 0, 2, 3)
        blocks = balance.weight * blocks.reshape(-1, 4, 3, 4, 3).transpose(0, 1, 3, 2, 4)
        blocks = left[ends][:, :, None] @ blocks @ right[ends][:, None]
        rows, columns = np.repeat(ends, 4, axis=1).ravel(), np.tile(ends, 4).ravel()
        own, numbers = self._own[rows], self._at
        rows, columns = numbers[rows[own]] - self._mesh.first_node, numbers[columns[own]]
        found = rows, columns, blocks.reshape(-1, 3, 3)[own]
        return tuple(np.concatenate(parts) for parts in zip(found, at_walls, strict=True))

    def _linearise_walls(
        self, x: np.ndarray, balance: Balance, turns: Turns
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As :meth:`linearise`, for bars that touch walls between their nodes. Collective."""
        mesh, (ends, blocks) = self._mesh, self.at_walls.linearise(x, self._step)
        coordinates = np.zeros((mesh.n_local, 18))
        if self._any(len(ends)):
            coordinates[: mesh.n_owned] = self._coordinates(turns)(np.arange(mesh.n_owned))
            mesh.update_ghosts(coordinates)
        left, right = coordinates.reshape(-1, 2, 3, 3).transpose(1, 0, 2, 3)
        if self.symmetric:
            blocks = 0.5 * (blocks + blocks.transpose(0, 3, 4, 1, 2))
        blocks = balance.weight * left[ends][:, :, None] @ blocks.transpose(0, 1, 3, 2, 4) @ right[ends][:, None]
        rows, columns = np.repeat(ends, 2, axis=1).ravel(), np.tile(ends, 2).ravel()
        own = rows < mesh.n_owned
        return rows[own], self._numbers[columns[own]], blocks.reshape(-1, 3, 3)[own]

    def _coordinates(self, turns: Turns) -> Callable[[np.ndarray], np.ndarray]:
        """Return what gives owned nodes (k,) the matrices (k, 18) by which the rows and the columns of their Hessian
        are multiplied: of frames and supports."""
        supports = self._model.supports

        def of(rows: np.ndarray) -> np.ndarray:
            free = np.eye(3) * ~supports.fixed[rows][:, None]
            if supports.inclined is not None:
                every = np.tile(np.eye(3), (self._mesh.n_owned, 1, 1))
                every[supports.inclined.nodes] = supports.inclined.free
                free = free @ every[rows]
            left = right = free
            if turns is not None:
                place, *both = turns
                turned = np.flatnonzero(place[rows] >= 0)
                left, right = free.copy(), free.copy()
                left[turned] = free[turned] @ both[0][place[rows[turned]]]
                right[turned] = both[1][place[rows[turned]]] @ free[turned]
            return np.stack([left, right], axis=1).reshape(-1, 18)

        return of

    def free_part(self, start: np.ndarray, end: np.ndarray) -> float:
        """Return the part of the way from positions ``start`` to ``end``, both (local, 3), on which no bar passes
        through another, see :func:`free_part`; 1 for all of it. Collective."""
        found, parts = self._look(end, self._step, False), [(1.0, "")]
        if found is not None and found[1] is not None:
            x = self._gather(lambda rows: start[rows], 3)
            part, limiting = free_part(self._pairs, x, found[0].x[:, :3] - x)
            if limiting:
                parts.append((part, "bars {} and {}".format(*self.ids[limiting - 1].tolist())))
        if self.at_walls is not None:
            parts.append(self.at_walls.free_part(start, end))
        part, between = min(self.comm.allgather(min(parts)))
        self.between = between or self.between
        return part

    def _any(self, here: int) -> bool:
        """Return whether a number is not zero on some rank. Collective."""
        return here != 0 if self.comm.size == 1 else self.comm.allreduce(here != 0, op=MPI.LOR)

    def _report(self, failed: int | str, text: str) -> None:
        """End the run on all ranks if on some rank something has failed: a pair, counted from 1, or what is named, of
        which the text tells. Collective."""
        if self._any(bool(failed)):
            if failed and isinstance(failed, int):
                failed = "bars {} and {}".format(*self.ids[failed - 1].tolist())
            texts = self.comm.allgather(f"{failed}{text}" if failed else "")
            raise SimulationFailure(min(filter(None, texts)))

    def _renew(self, x: np.ndarray, step: float, way: float, move: float) -> None:
        """Find out whether the list of pairs still has all that may touch, else make it again. Collective."""
        mesh, owned = self._mesh, self._mesh.n_owned
        if self._limit > 0.0 and not self.stale:
            motion = self._reference, np.ascontiguousarray(x[:owned])
            left = self._skin - largest_change(self.comm, motion, mesh.n_nodes, self._thick + self._skin)
            if left > 0.25 * self._skin + move:
                self._limit = way + 0.998 * (left - move)
                return
        if step > 0.0:
            self._drift = self.comm.allreduce((x[:owned] - self._last.T).sum(axis=0)) / (mesh.n_nodes * step)
        self._search(x, move)
        self._reference[:] = x[:owned]
        self._limit, self.stale, self._most[:] = way + 0.998 * (self._skin - move), False, 0.0

    def of_row(self, name: str) -> float:
        """Return this rank's share of a value of the history: ``contacts``, ``overlap`` [m] or ``force`` [N], which are
        the largest of all ranks, on rank 0. Collective."""
        if name == "contacts":
            return float(self.sums[CONTACTS])
        value = self.comm.allreduce(float(self.sums[OVERLAP if name == "overlap" else FORCE]), op=MPI.MAX)
        return value if self.comm.rank == 0 else 0.0

    # what a checkpoint keeps: results do not depend on which other pairs are listed

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """What a checkpoint keeps, name to an order and this rank's part. Collective."""
        tables = {"self_contact.pairs": self._table()}
        if self.at_walls is not None:
            tables["self_contact.walls"] = self.at_walls.table()
        kept = {}
        for name, table in tables.items():
            counts = self.comm.allgather(len(table))
            order = NaturalOrder(self.comm, sum(counts[: self.comm.rank]) + np.arange(len(table)), sum(counts))
            kept |= {name: (order, table)} if sum(counts) else {}
        return kept

    def _table(self) -> np.ndarray:
        """Return numbers and memory (m, width + 3) of the counted pairs that touch."""
        keys, kept = self._touches()
        counted = self._pairs.counted[self._state == TOUCHING] if len(self._state) else slice(None)
        return np.column_stack([keys, kept])[counted]

    def numbers(self) -> dict[str, Any]:
        """What a checkpoint keeps besides. Collective."""
        return {
            "pairs": self.comm.allreduce(len(self._table())),
            "deepest": self.comm.allreduce(self.deepest, op=MPI.MAX),
            "walls": 0 if self.at_walls is None else self.comm.allreduce(len(self.at_walls.table())),
        }

    def orders(self, numbers: dict[str, Any]) -> dict[str, NaturalOrder]:
        """Return the orders in which :meth:`load_state` takes the arrays of a checkpoint with these numbers."""
        comm, counts = self.comm, {name: numbers[name] for name in ("pairs", "walls")}
        return {
            f"self_contact.{name}": NaturalOrder(comm, np.arange(*slab_range(n, comm.rank, comm.size)), n)
            for name, n in counts.items()
            if n
        }

    def load_state(
        self, numbers: dict[str, Any], arrays: dict[str, np.ndarray], x: np.ndarray, dissipated: float
    ) -> None:
        """Go on from what a checkpoint has kept, at positions (owned, 3), with what this rank has dissipated [J].
        Collective."""
        self.deepest, self.dissipated = float(numbers["deepest"]), dissipated
        self._take(arrays.get("self_contact.pairs", np.empty((0, WIDTH + 3))), x)
        if self.at_walls is not None:
            self.at_walls.take(arrays.get("self_contact.walls", np.empty((0, 2 + BAR_WIDTH))), x)

    def check_start(self, x: np.ndarray, earlier: SelfContact | None = None) -> None:
        """Check that no bar starts in a wall between its nodes, at positions (local, 3), unless bars and walls are
        those of an ``earlier`` stage. Collective.

        Raises
        ------
        InputError
            On all ranks; names the wall, the bar and its depth.
        """
        before = None if earlier is None else earlier.at_walls
        same = before is not None and self.at_walls is not None and before.names == self.at_walls.names
        if self.at_walls is not None and not (same and np.array_equal(self.chosen, earlier.chosen)):
            self.at_walls.check_start(x, self._model.size)

    def overlap_at_start(self, earlier: SelfContact | None) -> float:
        """Return the largest overlap [m] of bars at the start of a stage that other bars or radii of the stage before,
        or no contact there, allowed; zero if these are the same. Collective."""
        same = earlier is not None and np.array_equal(self._radius, earlier._radius)
        same = same and np.array_equal(self.chosen, earlier.chosen)
        return self.comm.allreduce(0.0 if same else float(self.sums[OVERLAP]), op=MPI.MAX)

    def take_over(self, earlier: SelfContact | None, x: np.ndarray) -> None:
        """Go on from the end of an earlier stage, with contact of bars or not, at positions (owned, 3). Collective."""
        table = np.empty((0, WIDTH + 3))
        if earlier is not None:
            self.deepest, self.dissipated, table = earlier.deepest, earlier.dissipated, earlier._table()
        self._take(table, x)
        if self.at_walls is not None:
            before = None if earlier is None else earlier.at_walls
            same = before is not None and before.names == self.at_walls.names
            self.at_walls.take(before.table() if same else np.empty((0, 2 + BAR_WIDTH)), x)

    def _take(self, table: np.ndarray, x: np.ndarray) -> None:
        """Take pairs that touch (m, width + 3) from any ranks to those of their nodes. Collective."""
        self._empty()
        self._last[:] = x.T
        comm, starts, n_bars = self.comm, self._starts, self._mesh.n_bars
        ids = np.column_stack(np.divmod(table[:, 0].astype(np.int64), n_bars))
        ends = self._of_bars(ids.ravel())[:, :2].reshape(-1, 4).astype(np.int64)
        rows = np.hstack([ids, ends, np.ascontiguousarray(table[:, 1:]).view(np.int64)])
        rows = to_owners(rows, range(2, 6), starts, comm)
        self._keys = rows[:, 0] * n_bars + rows[:, 1]
        self._touching = np.ascontiguousarray(rows[:, 6:]).view(np.float64)
