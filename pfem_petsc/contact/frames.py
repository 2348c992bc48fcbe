"""Bounds on nodal coordinates for implicit steps, the oblique coordinates that turn planes into bounds, friction of
slipping nodes, and relative coordinates of the nodes of rows.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import inlined, kernel
from ..tolerances import FREE_PART
from .rotations import along, dot, free_components, put, times, vector

if TYPE_CHECKING:
    from .rows import Alike, RowSet

_LEAST = 0.05  # of a pivot below which a row is deferred
_SINGULAR = 1e-6  # determinant of I - C below which a wedge is jammed


class SlipForces(NamedTuple):
    """Friction of slipping nodes (m,) at walls (w,).

    Attributes
    ----------
    known : (m, 3) known part of the friction forces [N]
    friction : (m, w) coefficients, zero where a wall exerts no friction
    origins : (m, w, 3) positions of the node without slip [m]
    start : (m, w, 3) a d [N]
    weight : (m,) b [N/m]
    """

    known: np.ndarray
    friction: np.ndarray
    origins: np.ndarray
    start: np.ndarray
    weight: np.ndarray


class Sliding:
    """Slipping nodes of a rank.

    Parameters
    ----------
    frames : NodalFrames
    at : (m,) indices of the nodes among the frames
    forces : SlipForces

    Attributes
    ----------
    nodes : (m,) owned local indices
    inverse : (m, 3, 3) of the frames' bases
    maps : (m, 3, 3) (I - C)^-1 at the last evaluation
    stiffness : (m, 3, 3) derivative of friction with respect to the node's position x, at the last evaluation [N/m]
    """

    def __init__(self, frames: NodalFrames, at: np.ndarray, forces: SlipForces) -> None:
        self.nodes, self.at, self.inverse, self.forces = frames.nodes[at], at, frames.inverse[at], forces
        self._walls = frames.rows[at], frames.ratios[at], frames.normals[at]
        self.maps, self.stiffness = np.tile(np.eye(3), (len(at), 1, 1)), np.zeros((len(at), 3, 3))

    def couple(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the residual (m, 3) with friction from the one without, in frame coordinates, at positions (m, 3)."""
        (rows, ratios, normals), (known, friction, origins, start, weight) = self._walls, self.forces
        way = start + weight[:, None, None] * (x[:, None, :] - origins)
        way -= np.einsum("mwi,mwi->mw", way, normals)[:, :, None] * normals
        size = np.maximum(np.linalg.norm(way, axis=2), 1e-300)
        directions = way / size[:, :, None]
        every = np.arange(len(self.nodes))
        coupling = np.zeros((len(self.nodes), 3, 3))
        turned = np.einsum("mji,mwj->mwi", self.inverse, directions)
        for k in range(rows.shape[1]):
            factor = friction[:, k] / ratios[:, k]
            coupling[every, :, np.maximum(rows[:, k], 0)] += factor[:, None] * turned[:, k]
        system = np.eye(3) - coupling
        system[np.abs(np.linalg.det(system)) < _SINGULAR] = np.eye(3)
        self.maps = np.linalg.inv(system)
        g = np.einsum("mij,mj->mi", self.maps, g - np.einsum("mji,mj->mi", self.inverse, known))
        # the change of friction as the direction of slip turns
        normal_forces = np.maximum(np.take_along_axis(g, np.maximum(rows, 0).astype(np.int64), axis=1) / ratios, 0.0)
        factor = friction * normal_forces * weight[:, None] / size
        outer = np.einsum("mwi,mwj->mwij", normals, normals) + np.einsum("mwi,mwj->mwij", directions, directions)
        self.stiffness[:] = np.einsum("mw,mwij->mij", factor, np.eye(3) - outer)
        return g


MIN_VOLUME = 0.04  # of the rows of B: cond(B) <= 2.6/0.04 = 65; two planes can share a node from 2.3 degrees
_PARALLEL = 1e-14  # 1 - |cos| of free parts of normals that share a row; the bound is exact only at the given position
_ALONG = 1e-15  # components of a unit normal off an axis that count as zero
_AXES = np.eye(3)


class NodalFrames:
    """Coordinates and bounds of nodes near walls.

    Attributes
    ----------
    nodes : (m,) owned local indices
    places : (m, 3) expected positions of the nodes, where planes were taken [m]
    basis, inverse : (m, 3, 3): y = B x
    lower, upper : (m, 3) bounds on y [m], infinite where there is no bound
    rows : (m, w) int8: the coordinate (0, 1, 2) that wall k bounds at the node, -1 for none
    ratios : (m, w) r of n = r b on components that are not prescribed, b the row: positive for a lower bound,
        negative for an upper one, 1 or -1 unless supports make different normals parallel
    shared : (m, w) bool: the coordinate belongs to another wall, parallel to rounding on these components, and the
        bound is exact at one position only
    bounds : (m, w) bounds of the walls on their coordinates [m]
    normals, offsets : (m, w, 3), (m, w) planes that have a row; offset -inf for the others
    oblique : whether any basis is not the identity
    contradiction : index in ``nodes`` of a node with infeasible bounds, -1 for none
    sliding : friction forces on nodes that slip
    """

    def __init__(self, nodes: np.ndarray, walls: int) -> None:
        m = len(nodes)
        self.nodes, self.places = nodes, np.zeros((m, 3))
        self.basis, self.inverse = np.zeros((2, m, 3, 3))
        self.lower, self.upper = np.full((m, 3), -np.inf), np.full((m, 3), np.inf)
        self.rows, self.shared = np.full((m, walls), -1, dtype=np.int8), np.zeros((m, walls), dtype=np.bool_)
        self.ratios, self.bounds = np.ones((m, walls)), np.zeros((m, walls))
        self.normals, self.offsets = np.zeros((m, walls, 3)), np.full((m, walls), -np.inf)
        self.oblique, self.contradiction = False, -1
        none, vectors = np.zeros((0, walls)), np.zeros((0, walls, 3))
        self.sliding = Sliding(self, nodes[:0], SlipForces(np.zeros((0, 3)), none, vectors, vectors, np.zeros(0)))

    def pin(self, at: np.ndarray, values: np.ndarray, which: np.ndarray) -> None:
        """Fix the coordinates ``which`` (k, 3) bool of the frames ``at`` (k,) at values (k, 3) [m]."""
        self.lower[at] = np.where(which, values, self.lower[at])
        self.upper[at] = np.where(which, values, self.upper[at])


class Planes(NamedTuple):
    """Planes of nodes (m,) near walls (w,).

    Attributes
    ----------
    fixed : (m, 3) bool, prescribed components: their axes are rows of B
    normals, offsets : (m, w, 3), (m, w) planes n . x >= d; offset -inf where a wall does not apply
    rank : (m, w) order in which planes are taken, usually the distance [m]
    places : (m, 3) expected positions of the nodes [m]
    """

    fixed: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    rank: np.ndarray
    places: np.ndarray


def pivots(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Choose pivots of matrices (g, p, q, d), with d components at each node, by elimination, largest part of a row at
    a node first.

    The coordinates of that node are reflected such that the part has one component. Coordinates without entries are not
    changed. Returns rows and columns (g, p) of the pivots, how many (g,) there are, and the reflections (g, q, d, d).
    """
    (g, p, q, d), left, every = matrices.shape, matrices.copy(), np.arange(len(matrices))
    rows, columns = np.zeros((2, g, p), dtype=np.int64)
    count, going, turns = np.zeros(g, dtype=np.int64), np.ones(g, dtype=bool), np.tile(np.eye(d), (g, q, 1, 1))
    for k in range(p):
        size = np.sqrt(np.einsum("gpqi,gpqi->gpq", left, left))
        at, node = np.divmod(size.reshape(g, -1).argmax(axis=1), q)
        going &= size[every, at, node] > _LEAST
        if not going.any():
            break
        some = np.flatnonzero(going)
        at, node, each = at[some], node[some], np.arange(len(some))
        mirror = -left[some, at, node] / size[some, at, node][:, None]
        slot = np.abs(mirror).argmax(axis=1)
        mirror[each, slot] += 1.0
        square = np.einsum("mi,mi->m", mirror, mirror)
        factor = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0.0)
        turn = np.eye(d) - factor[:, None, None] * mirror[:, :, None] * mirror[:, None, :]
        turns[some, node] = turns[some, node] @ turn
        left[some, :, node] = left[some, :, node] @ turn
        rows[some, k], columns[some, k] = at, d * node + slot
        count[some] += 1
        factors = left[some, :, node, slot] / left[some, at, node, slot][:, None]
        left[some] -= factors[:, :, None, None] * left[some, at][:, None]
        left[some, at] = 0.0
        left[some, :, node, slot] = 0.0
    return rows, columns, count, turns


class RelativeCoordinates:
    """Coordinates y of nodes in groups of rows that rub, or whose nodes meet walls other than plain planes.
    Construction is collective.

    y is x, except at the carriers: there it is the sum of weights times positions of a row, in which the row is a wall
    at that node. The transposed map turns forces: what presses on the relative coordinate acts on all nodes of the row,
    times their weights. Bounds, sticking and slipping of a row are then those of a node at a plane wall at rest
    (:mod:`~pfem_petsc.contact.frames`, :mod:`~pfem_petsc.contact.friction`). Rows of several tables over
    the same nodes share one carrier. A node that a wall stops is no carrier, nor is one whose supports prescribe more
    components than those of the other nodes of the row. Rows for which no node is left have no carrier.

    Parameters
    ----------
    rows : RowSet
    groups : (groups,) bool, those to which this applies
    tables : number of tables of rows in the model

    Attributes
    ----------
    anywhere : whether there are any on any rank
    friction, static : (tables,) coefficients of friction
    carrier : (r,) node of each row among those of the rows, -1 for none
    nodes, at : (m,) owned carriers, ascending, and a row of each
    """

    def __init__(self, rows: RowSet, groups: np.ndarray, tables: int) -> None:
        self.rows, self.groups = rows, groups
        comm = rows.mesh.comm
        self.anywhere = bool(comm.allreduce(bool(self.groups.any()), op=MPI.LOR))
        coefficients = np.zeros((tables, 2))
        coefficients[rows.source] = rows.friction
        comm.Allreduce(MPI.IN_PLACE, coefficients, op=MPI.MAX)
        self.friction, self.static = coefficients.T.copy()
        # nodes of rows whose supports let them carry the relative coordinate
        part = (rows.weights != 0.0) & rows.fixed[:, None]
        free = (rows.free > 0.0)[rows.ends]
        needed = (free & part[:, :, None]).any(axis=1, keepdims=True)
        self._may = part & (free | ~needed).all(axis=2) & groups[rows.group_of_row][:, None]
        # the first row over the same nodes, with whose carrier the first ones of other tables have a slot as well
        nodes = np.column_stack([rows.ends, rows.weights])
        _, first, same = np.unique(nodes, axis=0, return_index=True, return_inverse=True)
        self._first, self._slot = first[same.ravel()], np.zeros(len(rows.source), dtype=bool)
        self._slot[np.unique(np.column_stack([self._first, rows.source]), axis=0, return_index=True)[1]] = True
        self._take(np.full(len(rows.source), -1))

    def choose(self, stopped: np.ndarray, x: np.ndarray) -> None:
        """Choose the carriers for a solve, by elimination. Collective.

        Parameters
        ----------
        stopped : (owned,) bool, nodes that walls may stop
        x : (owned, 3) positions, by which rows are left without a carrier if not all can have one [m]
        """
        rows = self.rows
        every = rows.gather(np.column_stack([stopped, x]))
        may = self._may & (every[:, 0] == 0.0)[rows.ends] & (self._first == np.arange(len(self._first)))[:, None]
        carrier, values = np.full(len(rows.source), -1), rows.values(every[:, 1:])
        for groups in rows.alike_of(self.groups):
            order = np.argsort(values[groups.rows], axis=1, kind="stable")
            matrix = groups.dense(np.where(may, rows.weights, 0.0)[groups.rows])
            matrix /= np.maximum(np.abs(matrix).max(axis=2, keepdims=True), 1e-300)
            matrix = np.take_along_axis(matrix, order[:, :, None], axis=1)
            row, column, count, _ = pivots(matrix[:, :, ::-1, None])
            at, k = np.nonzero(np.arange(row.shape[1]) < count[:, None])
            carrier[groups.rows[at, order[at, row[at, k]]]] = groups.nodes[at, -1 - column[at, k]]
        self._take(np.where(self._slot, carrier[self._first], -1))

    def _take(self, carrier: np.ndarray) -> None:
        rows = self.rows
        self.carrier = carrier
        placed = np.flatnonzero(carrier >= 0)
        local = rows.where[carrier[placed]]
        own = local >= 0
        self.nodes, first = np.unique(local[own], return_index=True)
        self.at = placed[own][first]
        self._placed = placed[own]
        self._place = np.searchsorted(self.nodes, local[own])
        self._inverse = [(groups.nodes, np.linalg.inv(self.weights(groups))) for groups in rows.alike_of(self.groups)]

    def weights(self, groups: Alike) -> np.ndarray:
        """Return y by x (g, q, q) of groups alike."""
        weights = np.tile(np.eye(groups.nodes.shape[1]), (len(groups.nodes), 1, 1))
        group, row = np.nonzero(self.carrier[groups.rows] >= 0)
        where = groups.nodes[group] == self.carrier[groups.rows[group, row]][:, None]
        weights[group, where.argmax(axis=1)] = groups.dense(self.rows.weights[groups.rows])[group, row]
        return weights

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return y (owned, 3) of positions x (owned, 3) [m]. Collective."""
        y = x.copy()
        y[self.nodes] = self.rows.slips(self.rows.gather(x))[self.at]
        return y

    def forces(self, g: np.ndarray) -> np.ndarray:
        """Return the forces (owned, 3) on y of forces g (owned, 3) on x [N]. Collective."""
        every, g = self.rows.gather(g), g.copy()
        for nodes, inverse in self._inverse:
            every[nodes] = np.einsum("gab,gai->gbi", inverse, every[nodes])
        g[self.rows.here] = every[self.rows.mine]
        return g

    def stiffness(self, k: np.ndarray) -> np.ndarray:
        """Return the stiffness (owned,) of y by that of x (owned,) [N/m]: 1/k = sum of w^2/k of the nodes of a row that
        supports let move. Collective."""
        rows, total = self.rows, k.copy()
        soft = np.where(rows.free.any(axis=1), 1.0 / np.maximum(rows.gather(k), 1e-300), 0.0)
        soft = (rows.weights[self.at] ** 2 * soft[rows.ends[self.at]]).sum(axis=1)
        total[self.nodes] = np.where(soft > 0.0, 1.0 / np.maximum(soft, 1e-300), k[self.nodes])
        return total

    def put_planes(self, x: np.ndarray, nodes: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> None:
        """Write the rows with carriers at positions (owned, 3) as planes n . y >= d of owned nodes (k,), ascending,
        with the carriers among them: normals (k, tables, 3) and offsets (k, tables) [m]. Collective."""
        rows, every, at = self.rows, self.rows.gather(x), self._placed
        place, table = np.searchsorted(nodes, self.nodes)[self._place], rows.source[at]
        end = np.abs(rows.weights[at]).argmax(axis=1)
        n = rows.fixed_jacobian[at, end] / rows.weights[at, end][:, None]
        normals[place, table] = n
        offsets[place, table] = np.einsum("ri,ri->r", n, rows.slips(every)[at]) - rows.values(every)[at]


_FILLED = "basis", "lower", "upper", "rows", "ratios", "shared", "bounds"


def build_frames(nodes: np.ndarray, planes: Planes, tolerance: float = 0.0, least: float = MIN_VOLUME) -> NodalFrames:
    """Build frames of nodes (m,) from their planes, lowest rank first.

    Parameters
    ----------
    nodes : (m,) owned local indices
    planes : Planes
    tolerance : opposite bounds that overlap by at most this are replaced by their mean [m]
    least : volume of the rows below which a plane is deferred
    """
    frames = NodalFrames(nodes, planes.offsets.shape[1])
    frames.places, frames.normals = planes.places, planes.normals
    lower, upper = frames.lower, frames.upper
    order = np.argsort(planes.rank, axis=1, kind="stable")
    _build(planes, order, least, tuple(getattr(frames, name) for name in _FILLED))
    frames.inverse, frames.oblique = np.linalg.inv(frames.basis), bool((frames.basis != _AXES).any())
    infeasible, crossed = np.flatnonzero((lower > upper + tolerance).any(axis=1)), lower > upper
    frames.contradiction = int(infeasible[0]) if len(infeasible) else -1
    lower[crossed] = upper[crossed] = 0.5 * (lower[crossed] + upper[crossed])
    frames.offsets = np.where(frames.rows >= 0, planes.offsets, -np.inf)
    return frames


@inlined
def _rest(part, spanned, n):
    """Return the part of a unit vector orthogonal to n orthonormal vectors, and its length."""
    for _ in range(2):  # twice is enough for orthogonality to rounding
        for p in range(n):
            part = along(part, -dot(part, vector(spanned, p)), vector(spanned, p))
    return part, math.sqrt(dot(part, part))


@inlined
def _complete(basis, taken, spanned, n):
    """Fill the rows of a basis (3, 3) that are not ``taken``; the first n of ``spanned`` (3, 3) are orthonormal vectors
    of the span of the others."""
    for slot in range(3):
        if taken[slot]:
            continue
        # prefer the axis of the slot, to avoid needless rotations
        best = -1.0
        for shift in range(3):
            part, length = _rest(vector(_AXES, (slot + shift) % 3), spanned, n)
            if length > best + 1e-9:
                best = length
                put(basis, slot, times(1.0 / length, part))
        put(spanned, n, vector(basis, slot))
        n += 1


@kernel
def _build(planes, order, least, output):
    """Fill the arrays of :class:`NodalFrames` that ``_FILLED`` names; ``order`` (m, w): of the walls at each node."""
    fixed, normals, offsets, _, places = planes
    basis, lower, upper, rows, ratios, shares, bounds = output
    taken, spanned = np.zeros(3, dtype=np.bool_), np.zeros((3, 3))
    for i in range(len(order)):
        n, volume, own = 0, 1.0, basis[i]
        for c in range(3):
            taken[c] = fixed[i, c]
            if taken[c]:
                put(own, c, vector(_AXES, c))
                put(spanned, n, vector(_AXES, c))
                n += 1
        for wall in order[i]:
            if offsets[i, wall] == -math.inf:
                continue
            normal, slot, ratio, shared = vector(normals[i], wall), -1, 1.0, False
            free = free_components(normal, fixed[i])
            for row in range(3):
                if taken[row] and not fixed[i, row]:
                    other = free_components(vector(own, row), fixed[i])
                    lengths, common = dot(other, other) * dot(free, free), dot(other, free)
                    if dot(free, free) > FREE_PART and abs(common) > (1.0 - _PARALLEL) * math.sqrt(lengths):
                        slot, ratio, shared = row, common / dot(other, other), True
            if not shared:
                part, length = _rest(normal, spanned, n)
                if n == 3 or length * volume < least:
                    continue
                volume *= length
                for c in range(3):
                    if not taken[c] and (slot < 0 or abs(normal[c]) > abs(normal[slot])):
                        slot = c
                # the length along the axis is not enough: it is 1 to rounding for normals up to 1e-8 off the axis
                if max(abs(normal[(slot + 1) % 3]), abs(normal[(slot + 2) % 3])) <= _ALONG:
                    put(own, slot, vector(_AXES, slot))
                    ratio = 1.0 if normal[slot] > 0.0 else -1.0
                else:
                    put(own, slot, normal)
                put(spanned, n, times(1.0 / length, part))
                n += 1
                taken[slot] = True
            rows[i, wall], ratios[i, wall], bounds[i, wall] = slot, ratio, offsets[i, wall] / ratio
            turn, place = along(normal, -ratio, vector(own, slot)), vector(places, i)
            if shared and not turn[0] == turn[1] == turn[2] == 0.0:
                bounds[i, wall] = dot(vector(own, slot), place) - (dot(normal, place) - offsets[i, wall]) / ratio
                shares[i, wall] = True
            if ratio > 0.0:
                lower[i, slot] = max(lower[i, slot], bounds[i, wall])
            else:
                upper[i, slot] = min(upper[i, slot], bounds[i, wall])
        _complete(own, taken, spanned, n)
