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
requires less: by Gershgorin's theorem the square of the frequency of a node grows by at most the sum of 2 k/m over
the pairs that touch it, of which each new one gets at most half of what the step and the others leave. It is constant
while the pair touches. Pairs closer than R in the mesh keep their distance there instead of R.

Bars are searched with a skin. Pairs are evaluated when the ways of the nodes since then allow them to touch; a bar that
could jump over another in a step, or has passed its axis, ends the run.
"""

from __future__ import annotations

from collections.abc import Callable
from math import acosh, asin, exp, inf, pi, sqrt, tan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..fields import STATUS
from ..mechanics.compiled import inlined, kernel
from ..mesh.distribution import bars_of_group
from ..mesh.exchange import GhostExchange, Router
from ..mesh.slab import slab_of, slab_range
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from .neighbours import Points, Segments, find_pairs, largest_change, segment_distance
from .rows import owner_starts, to_owners

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from ..mechanics.block_pattern import BlockPattern
    from ..stepping.model import Model

_CROSSED = 0.1  # largest square of the sine of the angle from which bars touch in one point
_STIFFNESS = 1.0  # of a pair, over the harmonic mean of E A/l of its bars
_SHARE = 0.2  # of the mass of a pair over the square of the step, which its stiffness does not exceed
_ROOM = 0.1  # least sum of squared frequencies that a step must leave for contacts, over its inverse square
_SKIN = 0.2  # distance beyond the radii up to which pairs are listed, over the mean length of bars
_LEAST = 1e-3  # sum of radii of a pair, over that of its bars, below which they cross in the mesh and do not touch
_DEEP = 0.2  # overlap over the radius from which results are doubtful
_TAG = 7800  # of messages between ranks with nodes of the same pairs

TOUCHES, NORMAL, SPRING, VISCOUS, WIDTH = 0, 1, 4, 7, 8
"""Columns of the memory of a pair: whether it touches; unit normal from the first bar to the second; elastic part of
their slip [m]; normal force of the damper [N]; and their number."""


class PairArrays(NamedTuple):
    """Pairs of bars (m), ascending by their numbers.

    Attributes
    ----------
    ends : (m, 4) ends of the first bar and of the second, rows of :class:`NodeArrays`
    reach, crossed : (m,) sum of radii, or less [m]; square of the sine of the angle from which bars cross
    stiffness, drag : (m,) [N/m], largest damping [N s/m]
    counted : (m,) bool, whether sums of this rank include it
    wake : (m,) way of the nodes at which it may touch [m]
    """

    ends: np.ndarray
    reach: np.ndarray
    crossed: np.ndarray
    stiffness: np.ndarray
    drag: np.ndarray
    counted: np.ndarray
    wake: np.ndarray


class NodeArrays(NamedTuple):
    """Nodes of pairs: ``x`` (q, 6) positions and displacements in the step [m]; ``inverse`` (q,) of the masses [1/kg],
    zero for nodes that supports hold; ``force`` (q, 3) internal forces [N]."""

    x: np.ndarray
    inverse: np.ndarray
    force: np.ndarray


class Rooms(NamedTuple):
    """Room for a pair: gradient of the energy ``g`` (4, 3) [N]; both axes ``u``, ``v``, a ``way`` between them and the
    ``normal`` (3,)."""

    g: np.ndarray
    u: np.ndarray
    v: np.ndarray
    way: np.ndarray
    normal: np.ndarray


class PairLaw(NamedTuple):
    """Coulomb's coefficient of friction; damping ratio; the step [s]; the way of the nodes so far, and that from which
    they have come to where pairs may sleep [m], the same unless forces are only tried."""

    friction: float
    damping: float
    step: float
    way: float
    base: float


ENERGY, DISSIPATED, CONTACTS, OVERLAP, FORCE, DEPTH = range(6)
"""Sums over the counted pairs: stored energy, and that dissipated in the step [J]; how many touch. Largest overlap [m],
force [N], and overlap over the radius."""


@inlined
def _gradient(g, s, t, push, way):
    """Add the gradient of the energy by a force ``push`` between points of the bars, along the unit vector ``way``."""
    for c in range(3):
        g[0, c] += (1.0 - s) * push * way[c]
        g[1, c] += s * push * way[c]
        g[2, c] -= (1.0 - t) * push * way[c]
        g[3, c] -= t * push * way[c]


@inlined
def _point_way(x, ends, p, s, t, first, way):
    """Write the difference of points of both bars, or of their displacements (``first`` 3), and return its length."""
    square = 0.0
    for c in range(3):
        a = (1.0 - s) * x[ends[p, 0], first + c] + s * x[ends[p, 1], first + c]
        b = (1.0 - t) * x[ends[p, 2], first + c] + t * x[ends[p, 3], first + c]
        way[c] = b - a
        square += way[c] * way[c]
    return np.sqrt(square)


@inlined
def _foot(x, node, one, two):
    """Return the parameter from 0 to 1 of the point of a bar that is closest to a node."""
    along, square = 0.0, 0.0
    for c in range(3):
        d = x[two, c] - x[one, c]
        along += d * (x[node, c] - x[one, c])
        square += d * d
    return min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0


@inlined
def _axes(x, ends, p, u, v):
    """Write both axes; return their squares and their product."""
    uu = 0.0
    vv = 0.0
    uv = 0.0
    for c in range(3):
        u[c] = x[ends[p, 1], c] - x[ends[p, 0], c]
        v[c] = x[ends[p, 3], c] - x[ends[p, 2], c]
        uu += u[c] * u[c]
        vv += v[c] * v[c]
        uv += u[c] * v[c]
    return uu, vv, uv


@inlined
def _repel(pairs, p, x, s, t, rooms):
    """Write the gradient of the energy of a pair that touches at ``s`` and ``t``; return the energy, the sum of the
    forces, and their mean points."""
    g, u, v, way = rooms.g, rooms.u, rooms.v, rooms.way
    ends, k, reach = pairs.ends, pairs.stiffness[p], pairs.reach[p]
    uu, vv, uv = _axes(x, ends, p, u, v)
    for i in range(4):
        for c in range(3):
            g[i, c] = 0.0
    sine = max(1.0 - uv * uv / (uu * vv), 0.0) if uu * vv > 0.0 else 0.0
    q = min(sine / pairs.crossed[p], 1.0)
    m = q * q * q * (10.0 - q * (15.0 - 6.0 * q))
    energy = 0.0
    push = 0.0
    at = 0.0
    other = 0.0
    excess = 0.0  # of the energy where bars cross over that where they are parallel
    for j in range(5 if m < 1.0 else 1):
        weight = m if j == 0 else 0.5 * (1.0 - m)
        if j == 1:
            s, t = 0.0, _foot(x, ends[p, 0], ends[p, 2], ends[p, 3])
        elif j == 2:
            s, t = 1.0, _foot(x, ends[p, 1], ends[p, 2], ends[p, 3])
        elif j == 3:
            s, t = _foot(x, ends[p, 2], ends[p, 0], ends[p, 1]), 0.0
        elif j == 4:
            s, t = _foot(x, ends[p, 3], ends[p, 0], ends[p, 1]), 1.0
        d = _point_way(x, ends, p, s, t, 0, way)
        overlap = reach - d
        if not overlap > 0.0:
            continue
        excess += 0.5 * k * overlap * overlap * (1.0 if j == 0 else -0.5)
        if weight == 0.0:
            continue
        force = weight * k * overlap
        energy += 0.5 * force * overlap
        push += force
        at += force * s
        other += force * t
        if d > 0.0:
            _gradient(g, s, t, force / d, way)
    if 0.0 < q < 1.0:
        slope = excess * 30.0 * q * q * (1.0 - q) * (1.0 - q) / pairs.crossed[p] * -2.0 * uv / (uu * vv)
        for c in range(3):
            of_u, of_v = slope * (v[c] - uv / uu * u[c]), slope * (u[c] - uv / vv * v[c])
            g[0, c] -= of_u
            g[1, c] += of_u
            g[2, c] -= of_v
            g[3, c] += of_v
    return energy, push, at, other


@inlined
def _damp(pairs, p, law, push, closing, mobility):
    """Return the normal force of spring and damper, which pulls never [N]; ``closing`` is the change of the distance in
    the step. The velocity is that at the end of the step, half a step later, by the force itself."""
    if law.damping <= 0.0 or law.step <= 0.0 or mobility <= 0.0:
        return push
    drag = min(2.0 * law.damping * np.sqrt(pairs.stiffness[p] / mobility), pairs.drag[p])
    return max((push - drag * closing / law.step) / (1.0 + 0.5 * drag * law.step * mobility), 0.0)


@inlined
def _slide(old, new, p, k, most, rooms):
    """Advance the elastic slip of a pair, at ``most`` as given [m], by the way of its points; return the energy stored,
    and that dissipated."""
    way, normal = rooms.way, rooms.normal
    along = 0.0
    dot = 0.0
    before = 0.0
    for c in range(3):
        along += way[c] * normal[c]
        dot += old[p, SPRING + c] * normal[c]
        before += old[p, SPRING + c] * old[p, SPRING + c]
    left = 0.0
    for c in range(3):  # turned into the plane across the normal
        new[p, SPRING + c] = old[p, SPRING + c] - dot * normal[c]
        left += new[p, SPRING + c] * new[p, SPRING + c]
    turned = np.sqrt(before / left) if left > 0.0 else 0.0
    square = 0.0
    for c in range(3):
        trial = turned * new[p, SPRING + c] + way[c] - along * normal[c]
        square += trial * trial
    factor = most / np.sqrt(square) if square > most * most else 1.0
    energy = 0.0
    lost = 0.0
    for c in range(3):
        start = turned * new[p, SPRING + c]
        trial = start + way[c] - along * normal[c]
        end = factor * trial
        lost += 0.5 * k * (start + end) * (trial - end)
        energy += 0.5 * k * end * end
        new[p, SPRING + c] = end
    return energy, lost


@inlined
def _farthest_move(x, ends, p):
    """Return the square of the largest relative displacement of ends of both bars in the step."""
    farthest = 0.0
    for i in range(2):
        for j in range(2, 4):
            square = 0.0
            for c in range(3):
                moved = x[ends[p, j], 3 + c] - x[ends[p, i], 3 + c]
                square += moved * moved
            farthest = max(farthest, square)
    return farthest


@kernel
def evaluate_pairs(pairs, old, new, nodes, law, out):
    """Compute forces and sums of all pairs, and their memory ``new`` (m, width) from the ``old`` one.

    ``pairs``: PairArrays; ``nodes``: NodeArrays, to whose forces those of pairs are added; ``law``: PairLaw; ``out``
    (6,): sums from :data:`ENERGY` on. Returns 0, or 1 plus the pair that has passed through itself, or minus that of
    one that moves too far in a step.
    """
    x, ends, failed = nodes.x, pairs.ends, 0
    segments = ends.reshape(-1, 2)
    rooms = Rooms(np.zeros((4, 3)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    g, way, normal = rooms.g, rooms.way, rooms.normal
    for p in range(len(ends)):
        if pairs.wake[p] > law.way:
            continue
        d, s, t = segment_distance(x, segments, 2 * p, 2 * p + 1)
        k, reach, touched = pairs.stiffness[p], pairs.reach[p], old[p, TOUCHES] > 0.0
        energy = 0.0
        lost = 0.0
        push = 0.0
        at = 0.0
        other = 0.0
        if d < reach:
            energy, push, at, other = _repel(pairs, p, x, s, t, rooms)
        if not touched:
            farthest = _farthest_move(x, ends, p)
            if failed == 0 and farthest > 0.25 * reach * reach and d < reach + np.sqrt(farthest):
                failed = -1 - p
        if push > 0.0:
            s, t = at / push, other / push
        _point_way(x, ends, p, s, t, 3, way)
        if push <= 0.0:
            if touched:  # what spring and damper held is lost
                for c in range(3):
                    lost += 0.5 * k * old[p, SPRING + c] * old[p, SPRING + c]
                    lost -= 0.5 * old[p, VISCOUS] * way[c] * old[p, NORMAL + c]
            else:
                pairs.wake[p] = law.base + (d - reach)
            for c in range(len(old[p])):
                new[p, c] = 0.0
            if pairs.counted[p]:
                out[DISSIPATED] += lost
            continue
        apart = _point_way(x, ends, p, s, t, 0, normal)
        turn = 0.0
        closing = 0.0
        for c in range(3):
            normal[c] = normal[c] / apart if apart > 0.0 else 0.0
            turn += normal[c] * old[p, NORMAL + c]
            closing += normal[c] * way[c]
        if apart <= 0.0 or (touched and turn < 0.0):
            failed = 1 + p if failed <= 0 else failed
        mobility = (1.0 - s) ** 2 * nodes.inverse[ends[p, 0]] + s**2 * nodes.inverse[ends[p, 1]]
        mobility += (1.0 - t) ** 2 * nodes.inverse[ends[p, 2]] + t**2 * nodes.inverse[ends[p, 3]]
        total = _damp(pairs, p, law, push, closing, mobility)
        lost -= 0.5 * (old[p, VISCOUS] + total - push) * closing
        if total != push:
            _gradient(g, s, t, total - push, normal)
        held = 0.0
        if law.friction > 0.0:
            held, rubbed = _slide(old, new, p, k, law.friction * total / k, rooms)
            lost += rubbed
            for c in range(3):
                way[c] = -new[p, SPRING + c]
            _gradient(g, s, t, k, way)
        new[p, TOUCHES] = 1.0
        new[p, VISCOUS] = total - push
        for c in range(3):
            new[p, NORMAL + c] = normal[c]
        for i in range(4):
            for c in range(3):
                nodes.force[ends[p, i], c] += g[i, c]
        pairs.wake[p] = 0.0
        if pairs.counted[p]:
            out[ENERGY] += energy + held
            out[DISSIPATED] += lost
            out[CONTACTS] += 1.0
            out[OVERLAP] = max(out[OVERLAP], reach - d)
            out[FORCE] = max(out[FORCE], np.sqrt(total * total + 2.0 * k * held))
            out[DEPTH] = max(out[DEPTH], 2.0 * (reach - d) / reach)
    return failed


@kernel
def distances_of(x, segments, apart):
    """Write the distances (m,) [m] of segments (2 m, 2) next to each other, between points x (q, 3 or more)."""
    for p in range(len(apart)):
        apart[p], _, _ = segment_distance(x, segments, 2 * p, 2 * p + 1)


@kernel
def largest_move(x, last, drift):
    """Return the largest distance of nodes at x (n or more, 3) from last (n, 3) + drift (3,); infinite for NaN."""
    most = 0.0
    for i in range(len(last)):
        square = 0.0
        for c in range(3):
            d = x[i, c] - last[i, c] - drift[c]
            square += d * d
        if not square <= most:
            most = square if square == square else np.inf
    return np.sqrt(most)


def restitution_of(damping: float) -> float:
    """Return the ratio of velocities after and before an impact on a spring and a damper that never pull.

    Source: Schwager and Pöschel, Granular Matter 9 (2007), 465, in terms of the damping ratio.
    """
    if damping < 1.0:
        angle = asin(damping)
        return exp(-tan(angle) * (pi - 2.0 * angle))
    if damping == 1.0:
        return exp(-2.0)
    return exp(-2.0 * damping / sqrt(damping * damping - 1.0) * acosh(damping))


def damping_of(restitution: float) -> float:
    """Return the damping ratio for :func:`restitution_of`, by bisection."""
    low, high = 0.0, 1e3
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if restitution_of(middle) > restitution else (low, middle)
    return 0.5 * (low + high) if restitution < 1.0 else 0.0


class SelfContact:
    """Contact of bars with bars, an :class:`~pfem_petsc.mechanics.elements.ElementFamily`. Construction is collective.

    Parameters
    ----------
    model : Model, whose case has ``[self_contact]``; with masses and supports

    Attributes
    ----------
    dissipated : energy that this rank's counted pairs have lost [J]
    sums : (6,) of the last forces, see :data:`ENERGY`
    deepest : largest overlap so far over the radius
    stale : whether bars have left the model since the last search

    Raises
    ------
    InputError
        On all ranks, for a group of bars that the mesh does not have.
    """

    energies = ("self_contact_energy", "self_contact_dissipation")

    def __init__(self, model: Model) -> None:
        self._model, self._mesh, self.comm = model, model.mesh, model.comm
        table, mesh, comm = model.case.self_contact, model.mesh, model.comm
        with agreed(comm):
            chosen = np.ones(len(mesh.bars), dtype=bool)
            if table.bars is not None:
                chosen[:] = False
                chosen[bars_of_group(model.case, mesh, "self_contact.bars", str(table.bars))] = True
        chosen &= mesh.bar_ids < mesh.n_bars - mesh.n_connectors
        self._bars = np.arange(len(mesh.bars), dtype=np.int32)[mesh.counted]
        self._bars = self._bars[chosen[self._bars]]
        self._radius = model.bars.radii() if table.radius is None else np.full(len(mesh.bars), float(table.radius))
        lengths = model.bars.mesh_lengths[self._bars]
        sums = comm.allreduce(np.array([lengths.sum(), len(lengths)]))
        self._thick = 2.0 * comm.allreduce(float(self._radius[self._bars].max(initial=0.0)), op=MPI.MAX)
        self._skin = _SKIN * sums[0] / max(sums[1], 1.0)
        self._friction, self._damping = float(table.friction), damping_of(float(table.restitution))
        self._starts = owner_starts(mesh)
        self._numbers = np.concatenate([mesh.first_node + np.arange(mesh.n_owned), mesh.ghost_numbers])
        self._make_directory()
        self._h, self._room = 0.0, 0.0
        self.dissipated, self.deepest, self.stale = 0.0, 0.0, False
        self.sums = np.zeros(6)
        self._way, self._limit, self._drift = 0.0, -1.0, np.zeros(3)
        self._reference, self._last = mesh.points[: mesh.n_owned].copy(), mesh.points[: mesh.n_owned].copy()
        self._exchange: GhostExchange | None = None
        self._install(np.empty((0, 2), dtype=np.int64), np.empty((0, WIDTH + 2)))

    def _make_directory(self) -> None:
        """Send the ends, radius and stiffness of all bars to the ranks of their slabs."""
        mesh, comm = self._mesh, self.comm
        ids = mesh.bar_ids[self._bars].astype(np.int64)
        router = Router(comm, slab_of(ids, mesh.n_bars, comm.size))
        begin, end = slab_range(mesh.n_bars, comm.rank, comm.size)
        at = router.send(ids) - begin
        self._first_bar, self._directory = begin, np.zeros((end - begin, 4))
        stiffness = self._model.bars.stiffness[self._bars]
        ends = self._numbers[mesh.bars[self._bars]]
        self._directory[at] = router.send(np.column_stack([ends, self._radius[self._bars], stiffness]))

    def begin(self, scheme: Scheme, h: float, frequency: float, critical: float) -> None:
        """Take the step [s], the highest frequency of the bars [rad/s] and the critical step [s].

        Raises
        ------
        InputError
            If the step leaves no room for the stiffness of contacts.
        """
        source, self._h = self._model.case.source, h
        if not scheme.explicit:
            raise InputError(
                f"{source}: [self_contact] needs an explicit integrator; use time.integrator = "
                '"central_differences", or remove the table'
            )
        if self._model.inertia.redistribution is not None or self._model.inertia.consistent:
            raise InputError(
                f'{source}: [self_contact] needs time.mass = "lumped", and no contact.treatment = "mass_redistribution"'
            )
        room = 1.0
        if np.isfinite(critical):
            room = min((frequency * h) ** 2 * ((critical / h) ** 2 - 1.0), 1.0)
        if room < _ROOM:
            raise InputError(
                f"{source}: time.step = {h:g} s leaves no room for the stiffness of [self_contact] below the critical "
                f"step of {critical:.6g} s; use at most {0.95 * critical:.6g} s"
            )
        self._room = room / (h * h)

    # pairs

    def _search(self, x: np.ndarray) -> None:
        """Make the list of pairs at positions (local, 3). Collective."""
        bars, model = self._bars, self._model
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
        self._install(found.ids.astype(np.int64), np.zeros((len(found.ids), WIDTH + 2)))

    def _of_bars(self, ids: np.ndarray) -> np.ndarray:
        """Return ends, radius and stiffness (n, 4) of bars by their numbers (n,). Collective."""
        wanted, place = np.unique(ids, return_inverse=True)
        asking = Router(self.comm, slab_of(wanted, self._mesh.n_bars, self.comm.size))
        return asking.reply(self._directory[asking.send(wanted) - self._first_bar])[place.ravel()]

    def _install(self, ids: np.ndarray, kept: np.ndarray) -> None:
        """Take pairs of bars (m, 2) from any ranks, with memory, stiffness and drag (m, 10); those that touch now keep
        theirs. Collective."""
        comm, mesh, starts = self.comm, self._mesh, self._starts
        of_bars = self._of_bars(ids.ravel()).reshape(-1, 2, 4)
        of_bars = np.hstack([of_bars[:, :, :2].reshape(-1, 4), of_bars[:, :, 2:].reshape(-1, 4)])
        rows = np.hstack([ids, of_bars[:, :4].astype(np.int64), np.hstack([of_bars[:, 4:], kept]).view(np.int64)])
        rows = to_owners(np.ascontiguousarray(rows), range(2, 6), starts, comm)
        numbers, ends = np.unique(rows[:, 2:6], return_inverse=True)
        data = np.ascontiguousarray(rows[:, 6:]).view(np.float64)
        own = (numbers >= starts[comm.rank]) & (numbers < starts[comm.rank + 1])
        if self._exchange is not None:
            self._exchange.close()
        self._exchange = GhostExchange(comm, starts, numbers[~own], _TAG)
        self._own, self._local = own, (numbers[own] - starts[comm.rank]).astype(np.int64)
        ends, sizes = ends.reshape(-1, 4), data[:, :4]  # radius and stiffness of both bars
        inertia, supports = self._model.inertia, self._model.supports
        inverse = np.where(supports.fixed.all(axis=1), 0.0, 1.0 / inertia.mass)
        of_nodes = np.column_stack([mesh.points[: mesh.n_owned], inertia.mass, inverse])
        of_nodes = self._gather(of_nodes.__getitem__, 5)
        reach = sizes[:, 0] + sizes[:, 2]
        apart = np.empty(len(ends))
        distances_of(of_nodes, ends.reshape(-1, 2), apart)
        axes = of_nodes[ends[:, 1::2], :3] - of_nodes[ends[:, ::2], :3]
        length = np.linalg.norm(axes, axis=2).min(axis=1, initial=inf)
        closer = np.minimum(reach, apart)
        used = closer > _LEAST * reach
        crossed = np.minimum(_CROSSED, (closer / length) ** 2)[used]
        ids, ends, data, closer = rows[used, :2], ends[used], data[used], closer[used]
        keys = ids[:, 0] * mesh.n_bars + ids[:, 1]
        memory = np.ascontiguousarray(data[:, 4:])
        if hasattr(self, "_keys"):
            touch = np.flatnonzero(self._memory[:, TOUCHES] > 0.0)
            place = np.searchsorted(keys, self._keys[touch])
            there = place < len(keys)
            there[there] = keys[place[there]] == self._keys[touch][there]
            touch, place = touch[there], place[there]
            memory[place, :WIDTH] = self._memory[touch]
            memory[place, WIDTH], memory[place, WIDTH + 1] = self._pairs.stiffness[touch], self._pairs.drag[touch]
        self._keys, self.ids, self._memory = keys, ids, np.ascontiguousarray(memory[:, :WIDTH])
        self._spare = self._memory.copy()
        counted = self._own[ends[:, 0]] if len(ends) else np.empty(0, dtype=bool)
        rest = memory[:, WIDTH].copy(), memory[:, WIDTH + 1].copy()
        self._pairs = PairArrays(np.ascontiguousarray(ends), closer, crossed, *rest, counted, np.zeros(len(ends)))
        self._inverse = of_nodes[:, 4].copy()
        fresh = self._pairs.stiffness == 0.0
        if comm.allreduce(bool(fresh.any()), op=MPI.LOR):
            self._stiffen(fresh, of_nodes[:, 3], data[:, [1, 3]])

    def _stiffen(self, fresh: np.ndarray, mass: np.ndarray, bars: np.ndarray) -> None:
        """Give new pairs their stiffness and largest damping, from masses of nodes (q,) [kg] and stiffness of both bars
        (m, 2) [N/m]. Collective."""
        pairs, n = self._pairs, len(mass)
        used = np.bincount(pairs.ends[~fresh].ravel(), np.repeat(pairs.stiffness[~fresh], 4), n)
        count = np.bincount(pairs.ends[fresh].ravel(), minlength=n)
        owned = np.zeros((self._mesh.n_owned, 2))
        owned[self._local] = np.column_stack([used, count])[self._own]
        used, count = self._gather(owned.__getitem__, 2).T
        ends = pairs.ends[fresh]
        left = 0.5 * np.maximum(0.5 * self._room * mass - used, 0.0) / np.maximum(count, 1.0)
        with np.errstate(divide="ignore"):
            own = 2.0 * _STIFFNESS / (1.0 / bars[fresh]).sum(axis=1)
        lighter = np.minimum(mass[ends[:, ::2]], mass[ends[:, 1::2]])
        inertial = _SHARE / self._h**2 / (1.0 / lighter).sum(axis=1) if self._h else inf
        pairs.stiffness[fresh] = np.minimum(np.minimum(own, inertial), left[ends].min(axis=1, initial=inf))
        limit = 0.5 * (mass / np.maximum(count, 1.0))[ends].min(axis=1, initial=inf)
        pairs.drag[fresh] = limit / self._h if self._h else 0.0

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
        step = self._model.bars.step
        return self.evaluate(x, f, step if step < np.inf else 0.0, commit)

    def evaluate(self, x: np.ndarray, f: np.ndarray, step: float, commit: bool) -> tuple[float, float]:
        """Add the forces at positions ``x``, a ``step`` [s] after the last that were committed, to ``f``, both
        (local, 3); return the stored energy and all that is dissipated [J]. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if a bar has passed through another, or may have.
        """
        worst = np.array([largest_move(x, self._last, step * self._drift), float(self.stale)])
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, worst, op=MPI.MAX)
        if not worst[0] < np.inf:  # of which other checks of the step tell
            return float(self.sums[ENERGY]), self.dissipated
        way = self._way + 2.0 * float(worst[0])
        if worst[1] or way >= self._limit:
            self._renew(x, step, way, 2.0 * float(worst[0]))
        nodes = self._gather(lambda rows: np.hstack([x[rows], x[rows] - self._last[rows]]), 6)
        force, sums = np.zeros((len(nodes), 3)), np.zeros(6)
        law = PairLaw(self._friction, self._damping, float(step), way, way if commit else 2.0 * self._way - way)
        arrays = NodeArrays(nodes, self._inverse, force)
        failed = int(evaluate_pairs(self._pairs, self._memory, self._spare, arrays, law, sums))
        self._report(failed, nodes)
        f[self._local] += force[self._own]
        total = self.dissipated + float(sums[DISSIPATED])
        if commit:
            self._memory, self._spare = self._spare, self._memory
            self._way, self.dissipated, self.sums = way, total, sums
            self.deepest = max(self.deepest, float(sums[DEPTH]))
            self._last[:] = x[: len(self._last)]
        return float(sums[ENERGY]), total

    def _report(self, failed: int, nodes: np.ndarray) -> None:
        """End the run on all ranks if pairs of some rank have passed through themselves. Collective."""
        text, comm = None, self.comm
        if failed:
            one, other = self.ids[abs(failed) - 1].tolist()
            ends = self._pairs.ends[abs(failed) - 1]
            if failed > 0:
                text = (
                    f"bars {one} and {other} pass through each other, which the stiffness of [self_contact] did not "
                    "prevent: reduce time.step, or use more elements, a larger self_contact.radius or lower velocities"
                )
            else:
                moves = nodes[ends[2:], None, 3:] - nodes[ends[None, :2], 3:].reshape(1, 2, 3)
                far = float(np.linalg.norm(moves, axis=2).max())
                text = (
                    f"bars {one} and {other}, which are about to touch, move {far:.3g} m relative to each other in a "
                    f"step, more than half the sum of their radii of {self._pairs.reach[abs(failed) - 1]:.3g} m, so "
                    "that contact may miss them: reduce time.step"
                )
        if comm.size > 1:
            flag = np.array([text is not None], dtype=np.int32)
            comm.Allreduce(MPI.IN_PLACE, flag, op=MPI.MAX)
            if flag[0]:
                text = min(each for each in comm.allgather(text) if each is not None)
        if text is not None:
            raise SimulationFailure(text)

    def _renew(self, x: np.ndarray, step: float, way: float, move: float) -> None:
        """Find out whether the list of pairs still has all that may touch, else make it again. Collective."""
        mesh, owned = self._mesh, self._mesh.n_owned
        if self._limit >= 0.0 and not self.stale:
            change = largest_change(self.comm, (self._reference, x[:owned]), mesh.n_nodes, self._thick + self._skin)
            left = self._skin - change
            if left > 0.25 * self._skin + move:
                self._limit = way + 0.998 * (left - move)
                return
        if step > 0.0:
            moved = self.comm.allreduce((x[:owned] - self._last).sum(axis=0)) / mesh.n_nodes
            self._drift = moved / step
        self._skin = max(self._skin, 4.0 * move)
        self._search(x)
        self._reference[:] = x[:owned]
        self._limit, self.stale = way + 0.998 * (self._skin - move), False

    def of_row(self, name: str) -> float:
        """Return this rank's share of a value of the history: ``contacts``, ``overlap`` [m] or ``force`` [N], which are
        the largest of all ranks, on rank 0. Collective."""
        if name == "contacts":
            return float(self.sums[CONTACTS])
        value = self.comm.allreduce(float(self.sums[OVERLAP if name == "overlap" else FORCE]), op=MPI.MAX)
        return value if self.comm.rank == 0 else 0.0

    # what a checkpoint keeps

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """What a checkpoint keeps, name to an order and this rank's part. Collective."""
        counted, pairs = self._pairs.counted, self._pairs
        counts = self.comm.allgather(int(counted.sum()))
        found = {"self_contact.reference": (self._mesh.node_order, self._reference)}
        if sum(counts):
            table = np.column_stack([self.ids, self._memory, pairs.stiffness, pairs.drag])[counted]
            numbers = sum(counts[: self.comm.rank]) + np.arange(len(table))
            found["self_contact.pairs"] = NaturalOrder(self.comm, numbers, sum(counts)), table
        return found

    def numbers(self) -> dict[str, Any]:
        """What a checkpoint keeps besides. Collective."""
        comm = self.comm
        return {
            "pairs": comm.allreduce(int(self._pairs.counted.sum())),
            "way": self._way,
            "limit": self._limit,
            "skin": self._skin,
            "drift": self._drift.tolist(),
            "stale": comm.allreduce(self.stale, op=MPI.LOR),
            "deepest": comm.allreduce(self.deepest, op=MPI.MAX),
        }

    def orders(self, numbers: dict[str, Any]) -> dict[str, NaturalOrder]:
        """Return the orders in which :meth:`load_state` takes the arrays of a checkpoint with these numbers."""
        n, comm = numbers["pairs"], self.comm
        slab = NaturalOrder(comm, np.arange(*slab_range(n, comm.rank, comm.size)), n)
        orders = {"self_contact.reference": self._mesh.node_order}
        return orders | ({"self_contact.pairs": slab} if n else {})

    def load_state(
        self, numbers: dict[str, Any], arrays: dict[str, np.ndarray], x: np.ndarray, dissipated: float
    ) -> None:
        """Go on from what a checkpoint has kept, at positions (owned, 3), with what this rank has dissipated [J].
        Collective."""
        table = arrays.get("self_contact.pairs", np.empty((0, WIDTH + 4)))
        self._keys, self._memory = self._keys[:0], self._memory[:0]
        self._install(table[:, :2].astype(np.int64), table[:, 2:])
        self._reference[:], self._last[:] = arrays["self_contact.reference"], x
        self._way, self._limit, self._skin = (float(numbers[name]) for name in ("way", "limit", "skin"))
        self._drift, self.stale = np.array(numbers["drift"]), bool(numbers["stale"])
        self.deepest, self.dissipated = float(numbers["deepest"]), dissipated

    def take_over(self, earlier: SelfContact, x: np.ndarray) -> None:
        """Go on from the end of an earlier stage, at positions (owned, 3). Collective."""
        pairs = earlier._pairs
        kept = np.column_stack([earlier._memory, pairs.stiffness, pairs.drag])[pairs.counted]
        touch = kept[:, TOUCHES] > 0.0
        self._install(earlier.ids[pairs.counted][touch], kept[touch])
        self._last[:], self.dissipated, self.deepest = x, earlier.dissipated, earlier.deepest

    # linear elements

    def add_product(self, weight: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add nothing: the plan of explicit steps leaves room for the stiffness of contacts."""

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Steps with discrete gradients are implicit."""
        raise NotImplementedError

    def add_tangents(self, weight: float, pattern: BlockPattern, values: np.ndarray) -> None:
        """Add nothing, as :meth:`add_product`: what modes are found of has no bars that touch."""
