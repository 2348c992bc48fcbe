"""Coordinates of implicit steps in which every contact pair is a bound on one unknown.

Of a pair with d . (x_c - x_o) >= gap, the node c that carries the bound has the coordinates w_c, the other node keeps
its own: with the free part of d at c of length l and direction m, b = (free part of d at o)/l, and the reflection H
that takes the axis e of the unknown into m,

    w_o = u_o,   w_c = H u_c - (b . u_o) e,   and back   u_c = H (w_c + (b . w_o) e),

so that e . w_c = m . u_c - b . u_o is the distance over l. The gradient follows: g_c <- H g_c, then
g_o <- g_o + b (e . g_c), and the pair's force is e . g_c / l. What supports prescribe is no part of m and b: it moves
the bound. The two nodes may be on two ranks. The coordinates are the same for every step, as the directions are.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from .pairs import ContactPairs

__all__ = ["PairCoordinates"]

_THIN = 1e-6  # length of a direction's free part below which supports alone decide


class PairCoordinates:
    """The change of coordinates for all pairs of a case.

    Attributes
    ----------
    carriers : (k,) owned nodes whose coordinates carry the bounds of pairs
    """

    def __init__(self, pairs: ContactPairs) -> None:
        self.pairs = pairs
        lengths = np.sqrt(np.einsum("epi,pi->ep", pairs.free, pairs.normals**2))
        self._at = np.flatnonzero(lengths.max(axis=0, initial=0.0) > _THIN)
        carrier = np.where(lengths[1] >= (1.0 - 1e-12) * lengths[0], 1, 0)[self._at]
        at, other = self._at, 1 - carrier
        self._length = lengths[carrier, at]
        direction = np.where(carrier == 1, 1.0, -1.0)[:, None] * pairs.normals[at]
        self._share = direction * pairs.free[other, at] / self._length[:, None]
        along = direction * pairs.free[carrier, at] / self._length[:, None]
        self._slot = np.abs(along).argmax(axis=1) if len(at) else np.zeros(0, dtype=np.int64)
        mirror = -along
        mirror[np.arange(len(at)), self._slot] += 1.0
        square = np.einsum("pi,pi->p", mirror, mirror)
        scale = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0.0)
        self._turn = np.eye(3) - scale[:, None, None] * mirror[:, :, None] * mirror[:, None, :]
        self._along = along
        self._carries, self._shares = pairs.mine[carrier, at], pairs.mine[other, at]
        self.carriers, self._other = pairs.local[carrier, at][self._carries], pairs.local[other, at][self._shares]
        self._slots = self._slot[self._carries]
        self._turns, self._shared = self._turn[self._carries], self._share[self._shares]

    def _across(self, here: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Numbers (p,) that the owners of some ends know, on all ranks. Collective."""
        data = np.zeros(len(self._at))
        data[here] = values
        return self.pairs.sum(data)

    def _of_others(self, u: np.ndarray) -> np.ndarray:
        """B . u_o of the pairs carried here. Collective."""
        return self._across(self._shares, np.einsum("pi,pi->p", self._shared, u[self._other]))[self._carries]

    def increment(self, w: np.ndarray) -> None:
        """Turn w (owned, 3) into u, in place. Collective."""
        w[self.carriers, self._slots] += self._of_others(w)
        w[self.carriers] = np.einsum("pij,pj->pi", self._turns, w[self.carriers])

    def coordinates(self, u: np.ndarray) -> None:
        """Turn u (owned, 3) into w, in place. Collective."""
        u[self.carriers] = np.einsum("pij,pj->pi", self._turns, u[self.carriers])
        u[self.carriers, self._slots] -= self._of_others(u)

    def gradient(self, g: np.ndarray) -> None:
        """Turn a gradient (owned, 3) by u into that by w, in place. Collective."""
        g[self.carriers] = np.einsum("pij,pj->pi", self._turns, g[self.carriers])
        pull = self._across(self._carries, g[self.carriers, self._slots])[self._shares]
        g[self._other] += pull[:, None] * self._shared

    def diagonal(self, blocks: np.ndarray, diagonal: np.ndarray) -> None:
        """Put the diagonal (owned, 3) of T^T H T in place of that of H at pairs; bars between the ends are left out.

        ``blocks`` (carriers, 3, 3): the diagonal blocks of H there. Collective.
        """
        turned = np.einsum("pji,pjk,pkl->pil", self._turns, blocks, self._turns)
        diagonal[self.carriers] = np.einsum("pii->pi", turned)
        stiff = self._across(self._carries, diagonal[self.carriers, self._slots])[self._shares]
        diagonal[self._other] += stiff[:, None] * self._shared**2

    def matrix(self) -> PETSc.Mat:
        """T with u = T w, which whoever calls must destroy. Collective."""
        mesh = self.pairs.mesh
        first, total = 3 * mesh.first_node, 3 * mesh.n_nodes
        node = self._across(self._shares, mesh.first_node + self._other).astype(np.int64)[self._carries]
        along, share = self._along[self._carries], self._share[self._carries]
        count = np.ones(3 * mesh.n_owned, dtype=np.int64)
        rows = (3 * self.carriers[:, None] + np.arange(3)).ravel()
        count[rows] = 6
        pointers = np.append(0, np.cumsum(count)).astype(PETSc.IntType)
        columns = np.zeros(pointers[-1], dtype=PETSc.IntType)
        values = np.ones(pointers[-1])
        plain = np.ones(3 * mesh.n_owned, dtype=bool)
        plain[rows] = False
        columns[pointers[:-1][plain]] = first + np.flatnonzero(plain)
        place = pointers[rows][:, None] + np.arange(6)
        own = first + 3 * self.carriers[:, None] + np.arange(3)
        both = np.concatenate([own, 3 * node[:, None] + np.arange(3)], axis=1)
        entries = np.concatenate([self._turns, along[:, :, None] * share[:, None, :]], axis=2)
        order = both.argsort(axis=1)  # PETSc takes rows with ascending columns
        columns[place] = np.repeat(np.take_along_axis(both, order, axis=1), 3, axis=0)
        values[place] = np.take_along_axis(entries, order[:, None, :], axis=2).reshape(-1, 6)
        matrix = PETSc.Mat().create(comm=mesh.comm)
        matrix.setSizes(((3 * mesh.n_owned, total), (3 * mesh.n_owned, total)), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR((pointers, columns, values))
        matrix.assemble()
        return matrix

    def reached(self, x: np.ndarray, move: np.ndarray, contact: np.ndarray, slack: float) -> bool:
        """Whether pairs can meet in a step: ends at (owned, 3) that move so far, or pressed before. Collective."""
        data = self.pairs.gather(np.concatenate([x + move, move, contact], axis=1))
        reach = 0.5 * np.linalg.norm(data[:, :, 3:6], axis=2).sum(axis=0) + slack
        near = self.pairs.distances(data[:, :, :3]) - self.pairs.gaps < reach
        return bool((near | data[0, :, 6:].any(axis=1))[self._at].any())

    def broken(self, x: np.ndarray, tolerance: float) -> bool:
        """Whether positions (owned, 3) break a pair by more than a tolerance [m]. Collective."""
        short = self.pairs.gaps - self.pairs.distances(self.pairs.gather(x))
        return bool((short[self._at] > tolerance).any())

    def bound(self, predictor: np.ndarray, u: np.ndarray, lower: np.ndarray) -> None:
        """Write the bounds on w into (owned, 3); of increments u, only what supports prescribe is used. Collective."""
        ends = self.pairs.gather(np.concatenate([predictor, u], axis=1))
        x = ends[:, :, :3] + np.where(self.pairs.free > 0.0, 0.0, ends[:, :, 3:])
        room = (self.pairs.gaps - self.pairs.distances(x))[self._at] / self._length
        lower[self.carriers, self._slots] = room[self._carries]

    def press(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        """Set the pairs' forces. Collective.

        Parameters
        ----------
        w, g : (owned, 3) solution in these coordinates [m], and imbalance by u there [N]
        lower : (owned, 3) bounds on w [m]
        noise : of the imbalance [N]
        """
        at, slot = self.carriers, self._slots
        pull = np.einsum("pi,pi->p", self._along[self._carries], g[at])
        pressed = (w[at, slot] <= lower[at, slot]) & (pull > noise)
        strength = self._across(self._carries, np.where(pressed, pull, 0.0)) / self._length
        self.pairs.release()
        self.pairs.force[self._at] = strength
