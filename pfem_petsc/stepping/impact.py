"""Kinetic energy lost in impact, computed independently of the scheme from the approach velocities."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel, record
from ..tolerances import ON_BOUND

if TYPE_CHECKING:
    from ..contact.wall_motion import Poses
    from .stepper import Stepper


@kernel
def join_nodes(met, touched, present):
    """Return the union of two lists of nodes, the first one first; ``present`` (owned,) is workspace, all False."""
    nodes = np.empty(len(met) + len(touched), dtype=np.int64)
    count = 0
    for i in met:
        present[i] = True
        nodes[count] = i
        count += 1
    for i in touched:
        if not present[i]:
            nodes[count] = i
            count += 1
    for i in met:
        present[i] = False
    return nodes[:count].copy()


@record
class Touched(NamedTuple):
    """Contacts of the nodes (owned,) of a rank with walls (w,).

    Attributes
    ----------
    touching : (owned, w) bool, contacts in this step
    closed : (owned, w) bool, contacts that have closed and whose node has not left the wall; updated
    fixed : (owned, 3) bool, prescribed components
    restitution : (w,)
    counted : (w,) bool, walls that contribute to the energy that closing contacts lose
    slack : distance at which a node has left [m]
    """

    touching: np.ndarray
    closed: np.ndarray
    fixed: np.ndarray
    restitution: np.ndarray
    counted: np.ndarray
    slack: float


@kernel
def closed_nodes(nodes, touched):
    """Return those nodes that are on walls or have not left them yet."""
    found, count = np.empty_like(nodes), 0
    for i in nodes:
        if touched.closed[i].any():
            found[count] = i
            count += 1
    return found[:count].copy()


@kernel
def stop_nodes(nodes, normals, gaps, speeds, towards, touched, mass):
    """Mark contacts of nodes (m,) that have closed or opened, and return the energy [J] that they lose by closing.

    Parameters
    ----------
    normals, gaps : (m, w, 3), (m, w) of walls [m]
    speeds : (m, w) velocities of the nodes along the normals beside those of the walls, without contact [m/s]; replaced
        by approach velocities of closing contacts, else zero
    towards : (m, w) accelerations of the nodes towards the walls, without contact [m/s2]
    touched : Touched
    mass : (owned,)
    """
    touching, closed, fixed = touched.touching, touched.closed, touched.fixed
    restitution, counted, slack = touched.restitution, touched.counted, touched.slack
    w = closed.shape[1]
    loss = 0.0
    basis = np.empty((3, 3))
    row = np.empty(3)
    before, after = np.empty(3), np.empty(3)
    for j in range(len(nodes)):
        i = nodes[j]
        fresh = False
        for k in range(w):
            speed, speeds[j, k] = speeds[j, k], 0.0
            if touching[i, k]:
                if not closed[i, k]:
                    closed[i, k] = True
                    if speed < 0.0:
                        square = speed * speed + 2.0 * towards[j, k] * max(gaps[j, k], 0.0)
                        speeds[j, k] = np.sqrt(max(square, 0.0))
                        fresh = fresh or counted[k]
            elif closed[i, k] and gaps[j, k] > slack:
                closed[i, k] = False
        if not fresh:
            continue
        # the minimum-norm velocity with these components along the normals, from an orthogonal basis of their span
        size = 0
        for first in (True, False):
            for k in range(w):
                if size == 3 or not touching[i, k] or not counted[k] or (speeds[j, k] > 0.0) != first:
                    continue
                left, left_after = speeds[j, k], restitution[k] * speeds[j, k]
                for c in range(3):
                    row[c] = 0.0 if fixed[i, c] else normals[j, k, c]
                for b in range(size):
                    share = row[0] * basis[b, 0] + row[1] * basis[b, 1] + row[2] * basis[b, 2]
                    for c in range(3):
                        row[c] -= share * basis[b, c]
                    left -= share * before[b]
                    left_after -= share * after[b]
                length = np.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2])
                if length <= 1e-8:
                    continue
                for c in range(3):
                    basis[size, c] = row[c] / length
                before[size], after[size] = left / length, left_after / length
                size += 1
        for b in range(size):
            loss += 0.5 * mass[i] * (before[b] * before[b] - after[b] * after[b])
    return loss


class Impacts:
    """Closing contacts of this rank's nodes, step by step."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        contact = self.model.contact
        self.active = self.model.can_touch and stepper.scheme.inertial
        bodies = contact.motion.bodies
        self._counted = ~np.isin(contact.wall_of, bodies.at)
        self._free_rates = bodies.state.v  # at the start of the step
        self.slack = ON_BOUND * self.model.size
        treatment = stepper.treatment
        # nothing is lost if nodes have no mass along the normal, or if a treatment restores the work of contact
        self.elastic = treatment is not None and treatment.elastic

    @property
    def touched(self) -> Touched:
        """The contacts of this rank's nodes."""
        contact, log = self.model.contact, self.model.contact.log
        return Touched(log.touching, log.closed, contact.fixed, contact.restitution, self._counted, self.slack)

    def step(
        self,
        x: np.ndarray,
        motion: tuple[np.ndarray, np.ndarray],
        load: np.ndarray | None,
        time: float,
        poses: Poses,
    ) -> float:
        """Return the energy [J] lost in this rank's closing contacts in the step just solved.

        Collective with pairs or walls with mass.

        Parameters
        ----------
        x, motion : (owned, 3) positions at the start of the step of closure, and velocity and acceleration there; for
            schemes that solve for the next position, those of the balance
        load : (owned, 3) all forces there except contact and damping [N]; None if the scheme solves for the next
            position
        time, poses : of the walls there
        """
        if not self.active:
            return 0.0
        loss, log = 0.0, self.model.contact.log
        if self.model.contact.any:
            changing = np.flatnonzero((log.touching != log.closed).any(axis=1))
            loss = self.on_walls(changing, x, motion, load, time, poses)
        if len(self.model.links.two.at):
            loss += self.of_rows(x, motion, load)
        return 0.0 if self.elastic else loss

    def _free(
        self, nodes: np.ndarray, motion: tuple[np.ndarray, np.ndarray], load: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return velocities and accelerations (m, 3) without contact at the start of the step."""
        inertia, balance, (v, a) = self.model.inertia, self.stepper.balance, (each[nodes] for each in motion)
        if load is None and inertia.products:
            return v, a
        fixed, mass = self.model.supports.fixed[nodes], inertia.mass[nodes, None]
        damping = inertia.damping[nodes, None] if inertia.damped else 0.0
        if load is not None:
            return v, np.where(fixed, a, (load[nodes] - damping * v) / mass)
        u = self.stepper.state.contact[nodes] / (balance.alpha * mass + balance.eta * damping)
        u[fixed] = 0.0  # prescribed components are not changed by contact
        return v - balance.eta * u, a - balance.alpha * u

    def on_walls(
        self,
        nodes: np.ndarray,
        x: np.ndarray,
        motion: tuple[np.ndarray, np.ndarray],
        load: np.ndarray | None,
        time: float,
        poses: Poses,
    ) -> float:
        """Return the loss of nodes (m,) that begin or cease to touch walls, see :meth:`step`. Collective with walls
        with mass."""
        contact = self.model.contact
        free, last = contact.motion.bodies, self._free_rates
        self._free_rates = free.state.v
        if len(nodes) == 0 and (not free.any or self.model.comm.size == 1):
            return 0.0
        nodes = np.sort(nodes)  # sums do not depend on when nodes met walls
        every = np.ones((len(nodes), len(contact.wall_of)), dtype=bool)
        normals, gaps = contact.distances(every, x[nodes], poses, nodes)
        free_v, free_a = self._free(nodes, motion, load)
        rates = contact.rates(x[nodes], time, ahead=True)
        pulls = np.zeros((len(contact.names), 3))
        if free.any:
            pulls[free.at] = np.where(free.hinged[:, None], 0.0, free.weight / free.mass[:, None])
            linear, angular = np.zeros((2, len(contact.names), 3))
            linear[free.at], angular[free.at] = free.changes(None if load is None else last)
            unpushed = linear + np.cross(angular, contact.motion.arms(x[nodes], time))
            rates = rates + unpushed[:, contact.wall_of]
        relative = free_v[:, None, :] - rates, pulls[contact.wall_of] - free_a[:, None, :]
        speeds, towards = (np.einsum("mwc,mwc->mw", normals, each, order="C") for each in relative)
        loss = stop_nodes(nodes, normals, gaps, speeds, towards, self.touched, self.model.inertia.mass)
        if contact.ties.any:
            loss += self._tied(nodes, normals, speeds, free_v, rates)
        if free.any:
            loss += self._on_free_walls(nodes, x[nodes], normals, speeds)
        return loss

    def _tied(
        self, nodes: np.ndarray, normals: np.ndarray, speeds: np.ndarray, v: np.ndarray, rates: np.ndarray
    ) -> float:
        """Return the energy [J] of the tangential motion of nodes that become tied to walls."""
        contact = self.model.contact
        across = v[:, None, :] - rates
        across = across - np.einsum("mwi,mwi->mw", across, normals)[:, :, None] * normals
        across[contact.fixed[nodes][:, None, :] & np.ones(across.shape, dtype=bool)] = 0.0
        caught = (speeds > 0.0) & contact.ties.tying
        energy = 0.5 * self.model.inertia.mass[nodes, None] * (across * across).sum(axis=2)
        return float(energy[caught].sum())

    def _on_free_walls(self, nodes: np.ndarray, x: np.ndarray, normals: np.ndarray, speeds: np.ndarray) -> float:
        """Return the loss of nodes at x (m, 3) that close on a wall with mass together. Collective.

        With the motions g = (n, r x n) of the wall that the nodes stop, and its inertia A, it is sum m s^2/2 -
        b A'^-1 b/2, where b = sum m s g and A' = A + sum m g g^T.
        """
        contact, free = self.model.contact, self.model.contact.motion.bodies
        mass = self.model.inertia.mass[nodes]
        sums = np.zeros((len(free.at), 7, 7))
        for i, (k, pivot) in enumerate(zip(free.at, free.pivots(0.0), strict=True)):
            s, normal = speeds[:, contact.wall_of == k], normals[:, contact.wall_of == k]
            lever = np.cross((x - pivot)[:, None, :], normal)
            stopped = np.concatenate([s[:, :, None], normal, lever], axis=2)
            sums[i] = np.einsum("mw,mwi,mwj->ij", np.where(s > 0.0, mass[:, None], 0.0), stopped, stopped)
        self.model.comm.Allreduce(MPI.IN_PLACE, sums)
        if self.model.comm.rank:
            return 0.0
        loss = 0.0
        for i, restitution in enumerate(contact.restitution[contact.first[free.at]]):
            motions, inertia = free.inertias(i)
            given = motions @ sums[i, 1:, 0]
            kept = given @ np.linalg.solve(inertia + motions @ sums[i, 1:, 1:] @ motions.T, given)
            loss += 0.5 * (1.0 - restitution**2) * float(sums[i, 0, 0] - kept)
        return loss

    def of_rows(self, x: np.ndarray, motion: tuple[np.ndarray, np.ndarray], load: np.ndarray | None) -> float:
        """Return the loss of closing rows over two nodes whose second nodes this rank owns, with the reduced mass."""
        links, mass = self.model.links, self.model.inertia.mass
        two, force = links.two, links.force[links.two.at]
        at = np.flatnonzero((force > 0.0) != links.closed[two.at])
        if len(at) == 0:
            return 0.0

        def of_nodes(nodes: np.ndarray) -> np.ndarray:
            free_v, free_a = self._free(nodes, motion, load)
            return np.column_stack([x[nodes], free_v, free_a, mass[nodes]])

        ends = links.rows.gather_of(two.at[at], of_nodes)
        links.closed[two.at[at]], lost = two.close(at, force[at], ends, self.slack)
        return lost
