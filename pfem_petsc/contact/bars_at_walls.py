"""Bars at walls between their nodes: springs where the axis of a bar is beyond the surface of a wall, and reports of
bars that intersect walls.

Nodes do not pass walls, but a bar between them may pass through a sphere, a cylinder or over the edge of a surface of
triangles. With the least distance g of its axis from the surface, at the part t of its length, the energy of a bar
there is k/2 min(g, 0)^2. As g is a minimum over t, the force acts at t, and where two faces meet there, along the mean
of their normals that does not change g along the axis. Dampers give restitution, and springs across the normal, whose
force Coulomb's law limits, friction, as between bars (:mod:`~pfem_petsc.contact.self_contact`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..mechanics.compiled import kernel
from ..tolerances import BEYOND
from .bar_springs import CRITICAL, PairLaw, damp, damping_of, slide
from .rotations import dot, put, times, vector
from .wall_motion import Poses

if TYPE_CHECKING:
    from .walls.base import BaseWall

_SHARE = 0.2  # of the lighter node's mass over the square of the step, and of what this leaves, that is the stiffness
_PART = 0.1  # of the stiffness that a wall with mass may still have, for the bars that begin to touch it in a step
_BESIDE = 1e-7  # part of the length at which normals beside the place are taken
_NEXT_TO = 1e-6  # way by which positions differ for derivatives, over the length of a bar
_MIDDLE = 0.45  # of the thickness of a sheet, from which bars have passed it
_DEEPER = 0.25  # of the width of a wall, by which an iteration may move bars into it
_PLACES = 50  # at most, on the way of bars in a step, at which they are looked for in walls
_SKIN = 0.5  # distance from a wall up to which bars are listed, over the mean length of bars

SPRING, NORMAL, FORCE, MOMENT, PLACE, DAMPER, STIFFNESS, WIDTH = 0, 3, 6, 9, 12, 13, 14, 15
"""Columns of the memory of a bar at a wall: elastic part of the slip [m]; normal; force on the bar [N], and its moment
about the origin [N m]; where it acts, from 0 to 1 along the bar; the part of the damper along the normal [N]; and the
stiffness [N/m]."""


def small_walls(walls: Sequence[BaseWall]) -> list[int]:
    """Return the indices of the walls that a bar can cross while its nodes satisfy them."""
    return [k for k, wall in enumerate(walls) if np.isfinite(wall.width)]


def _applying(model: Any, walls: list[int], bars: np.ndarray | slice) -> np.ndarray:
    """Return (m, walls) bool: walls that stop both nodes of bars (m,). Collective."""
    contact, mesh = model.contact, model.mesh
    members = np.zeros((mesh.n_local, len(walls)))
    members[: mesh.n_owned] = contact.members[:, contact.first[walls]]
    if walls:
        mesh.update_ghosts(members)
    return (members[mesh.bars[bars]] > 0.0).all(axis=1)


class BarContacts(NamedTuple):
    """Bars (m,) that may touch a wall: ``stiffness`` (m,) [N/m], ``count`` (m,) of walls that their bars touch, and
    ``inverse`` masses of their nodes (m, 2) [1/kg], zero where supports hold these; ``memory`` (m, WIDTH) of the start
    of the step, and who ``touched`` (m,) then."""

    stiffness: np.ndarray
    count: np.ndarray
    inverse: np.ndarray
    memory: np.ndarray
    touched: np.ndarray


class BarMotion(NamedTuple):
    """A ``step`` [s] of bars (m,) at a wall: their ends ``x`` (m, 2, 3) at its end, and ``before`` [m], where they are
    deepest at ``t`` (m,) and the distances ``gaps`` (m,) there [m], and the ``poses`` of walls then, and ``earlier``
    ones."""

    x: np.ndarray
    t: np.ndarray
    gaps: np.ndarray
    before: np.ndarray
    poses: Poses
    earlier: Poses
    step: float


class Response(NamedTuple):
    """What a wall does to bars (m,): who touches it, and who has passed through it in the step (m,); forces on their
    ends (m, 2, 3) [N], energies stored, and those lost in the step (m,) [J], and what they remember (m, WIDTH)."""

    touch: np.ndarray
    passed: np.ndarray
    force: np.ndarray
    stored: np.ndarray
    lost: np.ndarray
    memory: np.ndarray


@kernel
def resist(law, here, push, slip, mobility, normals):
    """Return the forces along the normals (m,) of springs that ``push`` (m,) [N] with their dampers, elastic slips
    (m, 3) [m], and the energies (m,) [J] that both lose as bars ``slip`` (m, 3) [m] in a step.

    ``law``: PairLaw; ``here``: BarContacts; ``mobility`` (m,) of the distances [1/kg]; ``normals`` (m, 3) their
    derivatives, which at edges are shorter than 1. The force of a damper by the velocity at the end of a step also
    changes with those of the other walls that the bar touches.
    """
    total, end, lost = push.copy(), np.zeros(slip.shape), np.zeros(len(push))
    for p in range(len(push)):
        n, way, k, old = vector(normals, p), vector(slip, p), here.stiffness[p], here.memory[p]
        if push[p] > 0.0 and (law.lead > 0.0 or here.touched[p]):
            shared = PairLaw(law.friction, law.damping, law.step, law.way, law.base, law.lead * here.count[p])
            total[p] = damp(push[p], k, dot(n, way), mobility[p], shared, np.inf)
        size, spring = max(sqrt(dot(n, n)), 1e-300), (old[SPRING], old[SPRING + 1], old[SPRING + 2])
        most = law.friction * total[p] * size / max(k, 1e-300)
        stop, _, lost[p] = slide(spring, k, most, way, times(1.0 / size, n))
        put(end, p, stop)
        before = (old[NORMAL], old[NORMAL + 1], old[NORMAL + 2])
        lost[p] -= 0.5 * ((total[p] - push[p]) * dot(n, way) + old[DAMPER] * dot(before, way))
    return total, end, lost


class BarsAtWalls:
    """Bars of this rank, those of ``[self_contact]``, and the walls that they can cross between their nodes.

    Attributes
    ----------
    walls : indices of these walls
    names : of these walls
    time : of positions that are tried [s]
    rubs, damped : whether one of the walls has friction, restitution below one
    passed : what has passed through which of them in the last step that was tried or made, empty for nothing
    met : (walls,) bool, walls that have pushed this rank's counted bars
    force : (owned, 3) on nodes at the positions that were committed last [N]
    sums : (2, walls, 3) forces of walls on this rank's counted bars there [N], and their moments about the origin [N m]
    """

    def __init__(self, model: Any, chosen: np.ndarray) -> None:
        contact, mesh = model.contact, model.mesh
        self._model, self._contact, self._mesh = model, contact, mesh
        self.walls = [k for k in small_walls(contact.walls) if contact.walls[k].solid]
        self.names = [contact.names[k] for k in self.walls]
        self._bars = np.flatnonzero(chosen)
        counted = np.zeros(len(mesh.bars), dtype=bool)
        counted[mesh.counted] = True
        self._counted = counted[self._bars]
        self._applies, of_nodes = _applying(model, self.walls, self._bars), np.zeros((mesh.n_local, 2))
        of_nodes[: mesh.n_owned, 0] = model.inertia.mass
        of_nodes[: mesh.n_owned, 1] = np.where(model.supports.fixed.all(axis=1), 0.0, 1.0 / model.inertia.mass)
        mesh.update_ghosts(of_nodes)
        self._mass, self._inverse = of_nodes[mesh.bars[self._bars]].transpose(2, 0, 1)
        lengths = model.bars.mesh_lengths[self._bars]
        self._skin = _SKIN * float(lengths.mean()) if len(lengths) else 0.0
        self._near: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        first = contact.first[self.walls]
        self.rubs, self.damped = bool(contact.friction[first].any()), bool((contact.restitution[first] < 1.0).any())
        self.time, self.passed = 0.0, ""
        self._before, self.force = mesh.points.copy(), np.zeros((mesh.n_owned, 3))
        self.sums, self.met = np.zeros((2, len(contact.walls), 3)), np.zeros(len(contact.walls), dtype=bool)
        self.take(np.empty((0, 2 + WIDTH)), mesh.points[: mesh.n_owned])
        for k in self.walls:
            if contact.ties.any and contact.ties.tying[contact.first[k]]:
                model.warnings.append(
                    f"wall {contact.names[k]!r} ties nodes only: bars that touch it between their nodes slide on it"
                )

    @property
    def touches(self) -> bool:
        """Whether a bar of this rank touches a wall between its nodes."""
        return len(self._keys) > 0

    def _candidates(self, k: int, x: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the bars (m,), of those here, that may cross wall k, with nodes at x (local, 3) [m]."""
        there = poses.rest(k, x)
        if k in self._near:
            bars, before = self._near[k]
            if np.abs(there - before).max(initial=0.0) * sqrt(3.0) < 0.5 * self._skin:
                return bars
        a, b = there[self._mesh.bars[self._bars]].swapaxes(0, 1)
        near = self._contact.walls[k].gaps(0.5 * (a + b)) < 0.5 * np.linalg.norm(b - a, axis=1) + self._skin
        bars = np.flatnonzero(near & self._applies[:, self.walls.index(k)])
        self._near[k] = bars, there.copy()
        return bars

    def _poses(self, time: float) -> tuple[Poses, Poses]:
        """Return where walls were at the positions that were committed last, and where they are at a time [s]."""
        poses = self._contact.motion.poses(time)
        return poses if self._begun is None else self._contact.motion.poses(self._begun), poses

    def _touching(
        self, x: np.ndarray, step: float, time: float
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray, BarContacts, BarMotion]]:
        """For each wall that bars touch at x (local, 3) and a time [s], or have touched before, give its index, the
        keys of these bars, their ends (m, 2), and their contacts and motion in the step [s]."""
        contact, bars_here = self._contact, self._mesh.bars[self._bars]
        earlier, poses = self._poses(time)
        n, places = len(self._bars), []
        for i, k in enumerate(self.walls):
            near = i * n + self._candidates(k, x, poses)
            keys = np.union1d(near, self._keys[self._keys // max(n, 1) == i])
            t, gaps = contact.walls[k].deepest(poses.rest(k, x[bars_here[keys - i * n]]))
            found = (gaps < 0.0) | np.isin(keys, self._keys)
            places.append((keys[found], t[found], gaps[found]))
        keys, t, gaps = (np.concatenate(parts) for parts in zip(*places, strict=True))
        touched, memory = np.isin(keys, self._keys), np.zeros((len(keys), WIDTH))
        memory[touched] = self._memory[np.searchsorted(self._keys, keys[touched])]
        stiffness, count = self._stiffness(keys, touched, memory[:, STIFFNESS])
        for i, k in enumerate(self.walls):
            at = np.flatnonzero(keys // max(n, 1) == i)
            if len(at):
                bars = keys[at] - i * n
                ends = bars_here[bars]
                here = BarContacts(stiffness[at], count[at], self._inverse[bars], memory[at], touched[at])
                motion = BarMotion(x[ends], t[at], gaps[at], self._before[ends], poses, earlier, step)
                yield k, keys[at], ends, here, motion

    def _stiffness(self, keys: np.ndarray, touched: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the stiffness (m,) of contacts by their keys, and how many their bars have (m,). Collective.

        It is that of the bar along its axis, unless an explicit step requires less; contacts that have ``touched`` (m,)
        keep what they had ``before`` (m,), and those that begin share what these leave to their bar, and to a wall with
        mass."""
        walls, bars = np.divmod(keys, max(len(self._bars), 1))
        axial, room = self._model.bars.stiffness[self._bars[bars]], self._model.self_contact.room
        each, place, count = np.unique(bars, return_inverse=True, return_counts=True)
        if not room:
            return axial, count[place]
        used, fresh = (np.bincount(place, values, len(each)) for values in (before * touched, ~touched))
        most = 2.0 * _SHARE * room * self._mass[each].min(axis=1, initial=np.inf)
        left = np.minimum(axial, (0.5 * np.maximum(most - used, 0.0) / np.maximum(fresh, 1.0))[place])
        for i, k in enumerate(self.walls):
            mass, here = self._wall_mass(k), walls == i
            if mass < np.inf:
                mine = self._counted[bars] & here
                sums = np.array([before[mine & touched].sum(), np.count_nonzero(mine & ~touched)])
                used, fresh = self._mesh.comm.allreduce(sums)
                left[here] = np.minimum(left[here], _PART * max(_SHARE * room * mass - used, 0.0) / max(fresh, 1.0))
        return np.where(touched, before, left), count[place]

    def _wall_mass(self, k: int) -> float:
        """Return the least mass [kg] that wall k has for a push anywhere on it, infinite if it moves as prescribed."""
        bodies, reach = self._contact.motion.bodies, 0.5 * self._contact.walls[k].width
        for i in np.flatnonzero(bodies.at == k):
            motions, inertia = bodies.inertias(i)
            motions = motions * np.repeat([1.0, reach], 3)
            return 1.0 / float(np.linalg.eigvalsh(motions.T @ np.linalg.solve(inertia, motions))[-1])
        return np.inf

    def add_forces(self, x: np.ndarray, f: np.ndarray, step: float, commit: bool) -> tuple[float, float]:
        """Add the forces at positions x (local, 3) [m], a ``step`` [s] after those that were committed last, to
        internal forces ``f`` (local, 3) [N]; return the energy stored by this rank's counted bars, and that lost in the
        step [J]. Forces that are not a number stand for bars that have passed through a wall, see :attr:`passed`."""
        time = self._contact.state.time if commit else self.time
        total, sums, stored, lost = np.zeros((len(x), 3)), np.zeros_like(self.sums), 0.0, 0.0
        known = [(np.empty(0, dtype=np.int64), np.empty((0, WIDTH)))]
        self.passed, names = "", self._contact.names
        for k, keys, ends, here, motion in self._touching(x, step, time):
            found = self._respond(k, here, motion)
            mine = self._counted[keys % len(self._bars)]
            stored += float(found.stored[mine].sum())
            lost += float(found.lost[mine].sum())
            if found.passed.any():
                bar = self._mesh.bar_ids[self._bars[keys[found.passed][0] % len(self._bars)]]
                self.passed, found.force[found.passed] = f"bar {bar} passes through wall {names[k]!r}", np.nan
            np.add.at(total, ends, found.force)
            sums[:, k] = found.memory[mine][:, FORCE : MOMENT + 3].sum(axis=0).reshape(2, 3)
            known.append((keys[found.touch], found.memory[found.touch]))
        f -= total
        self._last_sums = sums
        if commit:
            self.force, self.sums, self._before[:], self._begun = total[: self._mesh.n_owned], sums, x, time
            self.met |= sums[0].any(axis=1)
            self._keys, self._memory = (np.concatenate(parts) for parts in zip(*known, strict=True))
        return stored, lost

    def pushes(self, x: np.ndarray, step: float, weight: float) -> np.ndarray:
        """Return the :attr:`sums` of a balance that has a ``weight`` for the forces at positions x (local, 3), a step
        [s] after those that were committed last, and the rest for those."""
        if weight:
            self.add_forces(x, np.zeros_like(x), step, commit=False)
            return weight * self._last_sums + (1.0 - weight) * self.sums
        return self.sums

    def linearise(self, x: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (m, 2) of bars that touch walls at positions x (local, 3), a step [s] after those that were
        committed last, and the derivatives (m, 2, 3, 2, 3) of their internal forces by the positions of the ends, as
        central differences."""
        found = [(np.empty((0, 2), dtype=np.int64), np.empty((0, 2, 3, 2, 3)))]
        for k, _, ends, here, motion in self._touching(x, step, self.time):
            m, size = len(ends), _NEXT_TO * np.linalg.norm(motion.x[:, 1] - motion.x[:, 0], axis=1)
            moves = np.concatenate([np.eye(6), -np.eye(6)]).reshape(12, 1, 2, 3) * size[:, None, None]
            x = (motion.x + moves).reshape(-1, 2, 3)
            t, gaps = self._contact.walls[k].deepest(motion.poses.rest(k, x))
            tried = motion._replace(x=x, t=t, gaps=gaps, before=np.tile(motion.before, (12, 1, 1)))
            copies = BarContacts(*(np.tile(array, (12, *(array.ndim - 1) * [1])) for array in here))
            forces = self._respond(k, copies, tried).force.reshape(2, 6, m, 6)
            slopes = (forces[1] - forces[0]) / (2.0 * size[:, None])
            found.append((ends, slopes.transpose(1, 2, 0).reshape(m, 2, 3, 2, 3)))
        ends, blocks = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return ends, blocks

    def free_part(self, start: np.ndarray, end: np.ndarray) -> tuple[float, str]:
        """Return the part of the way from positions ``start`` to ``end`` (local, 3) on which no bar here can pass
        through a wall, and the names of the bar and the wall that limit it."""
        contact, poses, ends = self._contact, self._contact.motion.poses(self.time), self._mesh.bars[self._bars]
        most, least, limiting = np.linalg.norm(end - start, axis=1)[ends].max(axis=1, initial=0.0), 1.0, ""
        for i, k in enumerate(self.walls):
            wall = contact.walls[k]
            room = _DEEPER * wall.depth
            fast = np.flatnonzero((most > room) & self._applies[:, i])
            if len(fast):
                a, b = poses.rest(k, start)[ends[fast]].swapaxes(0, 1)
                gaps = wall.gaps(0.5 * (a + b)) - 0.5 * np.linalg.norm(b - a, axis=1)
                parts = (np.maximum(gaps, 0.0) + room) / most[fast]
                at = int(np.argmin(parts))
                if parts[at] < least:
                    bar = self._mesh.bar_ids[self._bars[fast[at]]]
                    least, limiting = 0.99 * float(parts[at]), f"bar {bar} and wall {contact.names[k]!r}"
        return least, limiting

    def crossing(self, x: np.ndarray, time: float) -> str:
        """Return the names of a bar and a wall that have passed through each other on the straight way from the
        positions that were committed last to x (local, 3) at a time [s], empty if none has. Collective."""
        contact, ends, here = self._contact, self._mesh.bars[self._bars], ""
        earlier, poses = self._poses(time)
        for i, k in enumerate(self.walls):
            wall = contact.walls[k]
            start, end = earlier.rest(k, self._before), poses.rest(k, x)
            most = np.linalg.norm(end - start, axis=1)[ends].max(axis=1, initial=0.0)
            fast = np.flatnonzero((most > _DEEPER * wall.depth) & self._applies[:, i])
            middle = 0.25 * (start[ends[fast]].sum(axis=1) + end[ends[fast]].sum(axis=1))
            long = np.linalg.norm(start[ends[fast, 1]] - start[ends[fast, 0]], axis=1)
            fast = fast[wall.gaps(middle) < 0.5 * long + most[fast]]
            if not len(fast):
                continue
            first, last = (wall.deepest(there[ends[fast]])[1] for there in (start, end))
            count = min(int(most[fast].max() / (_DEEPER * wall.depth)) + 2, _PLACES)
            for part in np.linspace(0.0, 1.0, count)[1:-1]:
                between = (1.0 - part) * start[ends[fast]] + part * end[ends[fast]]
                passed = wall.deepest(between)[1] < np.minimum(np.minimum(first, last), 0.0) - _DEEPER * wall.depth
                if passed.any():
                    bar = self._mesh.bar_ids[self._bars[fast[passed.argmax()]]]
                    here = f"bar {bar} and wall {contact.names[k]!r}"
        return max(self._mesh.comm.allgather(here))

    def check_start(self, x: np.ndarray, length: float) -> None:
        """Check that no bar starts in a wall, with nodes at x (local, 3), in a model of a ``length`` [m]. Collective.

        Raises
        ------
        InputError
            On all ranks; names the wall, the bar and its depth.
        """
        contact, poses, worst = self._contact, self._contact.motion.poses(0.0), (0.0, 0, 0)
        for i, k in enumerate(self.walls):
            bars = np.flatnonzero(self._applies[:, i])
            gaps = contact.walls[k].deepest(poses.rest(k, x[self._mesh.bars[self._bars[bars]]]))[1]
            if len(gaps) and gaps.min() < -BEYOND * length:
                worst = min(worst, (float(gaps.min()), k, int(self._mesh.bar_ids[self._bars[bars[gaps.argmin()]]])))
        depth, k, bar = min(self._mesh.comm.allgather(worst))
        if depth < 0.0:
            raise InputError(
                f"{contact.source}: wall {contact.names[k]!r}: bar {bar} starts {-depth:.6g} m in it, between its "
                "nodes; move the wall or the mesh, divide the bar, or name the bars that touch with self_contact.bars, "
                "or the nodes of the wall with 'node_set'"
            )

    def table(self) -> np.ndarray:
        """Return walls, bars and memory (m, 2 + WIDTH) of the counted bars that touch, for a checkpoint."""
        walls, bars = np.divmod(self._keys, max(len(self._bars), 1))
        rows = np.column_stack([walls, self._mesh.bar_ids[self._bars[bars]], self._memory])
        return rows[self._counted[bars]]

    def take(self, table: np.ndarray, x: np.ndarray) -> None:
        """Go on from bars that touch, rows of :meth:`table` of any ranks, at positions (owned, 3) [m]. Collective."""
        mesh, n = self._mesh, len(self._bars)
        state = self._contact.state
        self._begun = None if state is None else state.time
        self._before[: mesh.n_owned] = x
        mesh.update_ghosts(self._before)
        table = np.concatenate(mesh.comm.allgather(table))
        ids = mesh.bar_ids[self._bars].astype(np.int64)
        order, wanted = np.argsort(ids, kind="stable"), table[:, 1].astype(np.int64)
        place = order[np.minimum(np.searchsorted(ids[order], wanted), n - 1)] if n else wanted
        here = ids[place] == wanted if n else np.zeros(len(wanted), dtype=bool)
        keys = (table[:, 0].astype(np.int64) * n + place)[here]
        ascending = np.argsort(keys)
        self._keys, self._memory = keys[ascending], table[here][ascending, 2:]
        self.sums[:], total = 0.0, np.zeros((mesh.n_local, 3))
        walls, bars = np.divmod(self._keys, max(n, 1))
        for i, k in enumerate(self.walls):
            rows = self._memory[(walls == i) & self._counted[bars]]
            self.sums[:, k] = rows[:, FORCE : MOMENT + 3].sum(axis=0).reshape(2, 3)
        for end, part in enumerate((1.0 - self._memory[:, PLACE], self._memory[:, PLACE])):
            np.add.at(total, mesh.bars[self._bars[bars], end], part[:, None] * self._memory[:, FORCE : FORCE + 3])
        self.force = total[: mesh.n_owned]

    def _respond(self, k: int, here: BarContacts, motion: BarMotion) -> Response:
        """Return what wall k does to bars."""
        wall = self._contact.walls[k]
        gaps, touch = motion.gaps, motion.gaps < 0.0
        t = np.where(touch, motion.t, here.memory[:, PLACE])
        normals = motion.poses.turned(k, _normals(wall, motion.poses.rest(k, motion.x), t))
        weights = np.stack([1.0 - t, t], axis=1)
        point, start = (np.einsum("me,mei->mi", weights, ends) for ends in (motion.x, motion.before))
        slip = point - start - motion.earlier.ways(motion.poses, start)[:, k]
        stiffness, push = here.stiffness, np.where(touch, -here.stiffness * gaps, 0.0)
        mobility = (weights**2 * here.inverse).sum(axis=1) * (normals**2).sum(axis=1)
        mobility += self._wall_mobility(k, point, normals)
        law = self._law(k, motion.step)
        total, end, lost = resist(law, here, push, slip, mobility, normals)
        force = total[:, None] * normals - stiffness[:, None] * end
        before = here.memory[:, NORMAL : NORMAL + 3]
        passed = touch & here.touched & (np.einsum("mi,mi->m", before, normals) < 0.0)
        if wall.thickness is not None:  # beyond the middle of a sheet nothing pushes bars back
            passed |= gaps < -_MIDDLE * wall.thickness
        stored = np.where(touch, 0.5 * stiffness * (gaps**2 + np.einsum("mi,mi->m", end, end)), 0.0)
        memory = np.column_stack([end, normals, force, np.cross(point, force), t, total - push, stiffness])
        return Response(touch, passed, weights[:, :, None] * force[:, None, :], stored, lost, memory)

    def _wall_mobility(self, k: int, point: np.ndarray, normals: np.ndarray) -> np.ndarray | float:
        """Return the inverse masses [1/kg] with which wall k gives way at points (m, 3) along normals (m, 3)."""
        bodies = self._contact.motion.bodies
        for i in np.flatnonzero(bodies.at == k):
            motions, inertia = bodies.inertias(i)
            given = motions @ np.concatenate([normals, np.cross(point - bodies.pivots(0.0)[i], normals)], axis=1).T
            return (given * np.linalg.solve(inertia, given)).sum(axis=0)
        return 0.0

    def _law(self, k: int, step: float) -> PairLaw:
        """Return the law of contacts with wall k in a step [s]. In explicit steps dampers take the velocity at the end
        of the step, half a step later; in steps that solve equations they follow a step later where bars begin to
        touch."""
        slot = self._contact.first[k]
        restitution, friction = (float(each[slot]) for each in (self._contact.restitution, self._contact.friction))
        lead = 0.0 if self._model.self_contact.implicit else 0.5
        return PairLaw(friction, damping_of(max(restitution, CRITICAL)), step, 0.0, 0.0, lead)


def _normals(wall: BaseWall, ends: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the derivatives (m, 3) of the least distances of bars with ends (m, 2, 3) from a wall at rest by the
    positions of the places ``t`` (m,)."""
    along = ends[:, 1] - ends[:, 0]
    behind, ahead = (wall.planes(ends[:, 0] + (t + side * _BESIDE)[:, None] * along)[0] for side in (-1.0, 1.0))
    falls, rises = (np.einsum("mi,mi->m", normal, along) for normal in (behind, ahead))
    share = np.where(rises > falls, np.clip(rises / np.where(rises > falls, rises - falls, 1.0), 0.0, 1.0), 0.5)
    mean = share[:, None] * behind + (1.0 - share)[:, None] * ahead
    square = np.maximum(np.einsum("mi,mi->m", along, along), 1e-300)
    return mean - (np.einsum("mi,mi->m", mean, along) / square)[:, None] * along


class Piercing:
    """Detects bars across walls in each snapshot. Construction is collective.

    Attributes
    ----------
    walls : indices of the walls that are checked
    first : wall to the step and time of the first snapshot with a bar across it, as texts
    seen : wall to the number of snapshots with bars across it
    looks : number of snapshots checked
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self.walls = small_walls(model.contact.walls)
        self.first: dict[int, str] = {}
        self.seen = dict.fromkeys(self.walls, 0)
        self.looks = 0
        if not self.walls:
            return
        self._bars = model.mesh.bars[model.mesh.counted]
        self._applicable = _applying(model, self.walls, model.mesh.counted)

    def look(self, x: np.ndarray, time: float, at: str) -> list[str]:
        """Return new messages about bars at positions (local, 3), ghosts included. Collective.

        ``time`` is that of the stage [s], ``at`` the step and the time for messages.
        """
        if not self.walls:
            return []
        self.looks += 1
        poses = self._model.contact.motion.poses(time)
        here = [self._across(i, k, x, poses) for i, k in enumerate(self.walls)]
        found = np.array(self._model.comm.allgather(here))
        counts, lowest = found[:, :, 0].sum(axis=0), found[:, :, 1].min(axis=0)
        told = []
        for count, bar, k in zip(counts.tolist(), lowest.tolist(), self.walls, strict=True):
            self.seen[k] += count > 0
            if count and k not in self.first:
                self.first[k] = at
                bars = f"bar {bar} intersects" if count == 1 else f"{count} bars, including bar {bar}, intersect"
                told.append(f"{at}: {bars} wall {self._model.contact.names[k]!r}: {self._why(k)}")
        return told

    def _across(self, i: int, k: int, x: np.ndarray, poses: Poses) -> tuple[int, int]:
        """Return the number of this rank's bars across wall ``k``, and the lowest of their mesh numbers."""
        mesh, wall = self._model.mesh, self._model.contact.walls[k]
        rows = np.flatnonzero(self._applicable[:, i])
        starts, ends = (poses.rest(k, x[self._bars[rows, end]]) for end in (0, 1))
        ids = mesh.bar_ids[mesh.counted][rows[wall.crossed(starts, ends)]]
        return len(ids), int(ids.min()) if len(ids) else int(np.iinfo(np.int64).max)

    def _why(self, k: int) -> str:
        """Return why bars are in wall k, and what to do about it."""
        touch = self._model.self_contact
        if touch is not None and touch.at_walls is not None and k in touch.at_walls.walls:
            return "bars that touch are pressed into it, or not all bars do; use a smaller step, or all bars"
        return "only nodes touch walls; use shorter bars or a larger wall"

    def summary(self) -> list[str]:
        """Return messages for the end of the run, about walls that bars intersected again after the first message."""
        names = self._model.contact.names
        return [
            f"bars intersected wall {names[k]!r} in {self.seen[k]} of {self.looks} snapshots, first at "
            f"{self.first[k]}: {self._why(k).partition('; ')[0]}"
            for k in self.walls
            if self.seen[k] > 1
        ]
