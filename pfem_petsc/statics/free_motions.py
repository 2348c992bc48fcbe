"""What the stiffness shows where no equilibrium follows: motions that it does not resist, and limit points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..contact.transform import Transform
from ..errors import NotConverged
from ..solvers.linear import DIRECT, LinearChoice
from ..solvers.matrix import HessianMatrix
from ..stepping.problem import StepProblem
from .bordered import BorderedSystem
from .scheme import Equilibrium
from .stability import LARGEST, Stability

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["free_motions", "names_motions", "next_equilibrium"]

_ZERO = 1e-11  # of the largest stiffness of a node; limit points that steps come close to have 1e-6 and more
_MOST = 8  # motions that are looked at
_TOLD = 3
_NAMED = 4  # nodes besides the one that moves most
_AHEAD = 2.0, 0.5, 0.1, 0.02  # of an increment: near a limit point the response to a whole one is too large
_MOVES = 0.3  # of the largest displacement of a motion, above which a node is named


def names_motions(model: Model) -> bool:
    """Whether motions are looked at: in models without walls and links, of at most 30,000 unknowns."""
    return not model.can_touch and 3 * model.mesh.n_nodes <= LARGEST


def free_motions(model: Model, state: State) -> str:
    """What to add to a message about a stiffness that may be singular; empty where no motion is free. Collective.

    Models for which :func:`names_motions` is False get no answer.
    """
    if not names_motions(model):
        return ""
    matrix = HessianMatrix(model.mesh, model.supports)
    problem = StepProblem(model, state, Equilibrium().balance(state, 0.0), state.external, Transform(model))
    matrix.update(problem, np.zeros_like(state.position))
    scale = model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)
    stability = Stability(model, matrix)
    try:
        values, motions = ([], []) if stability.refusal else stability.nearest(_MOST, 0.1 * _ZERO * scale)
        count = int((np.abs(values) < _ZERO * scale).sum())
        free = stability.combined(motions[:count]) if count else []
    except (NotConverged, np.linalg.LinAlgError):
        free = []
    finally:
        stability.destroy()
        matrix.destroy()
    return _text(model, state, free)


def next_equilibrium(model: Model, state: State, size: float) -> str:
    """What the tangent stiffness shows about the load factors up to ``size`` beyond an equilibrium. Collective.

    The response to the load becomes infinite at a limit point. If one is nearer than an increment, twice this increment
    times the response is a displacement to states beyond it, where eigenvalues are negative, or zero in plastic
    mechanisms.
    """
    unknowns = 3 * model.mesh.n_nodes
    if model.can_touch:
        return "it may be a limit point, which is not examined where contact is possible"
    if unknowns > LARGEST:
        return f"it may be a limit point, which is not examined for {unknowns:,} unknowns, more than {LARGEST:,}"
    matrix = HessianMatrix(model.mesh, model.supports)
    stability = Stability(model, matrix)
    choice = LinearChoice("preonly", DIRECT[not stability.dense], "of the response")
    system = BorderedSystem(model, matrix, choice, None, Equilibrium(), size)
    try:
        if stability.refusal is not None:
            return f"it may be a limit point, which is not examined: {stability.refusal}"
        system.begin(state)
        rest = np.zeros_like(state.position)
        system.linearise(rest)
        here = stability.look().negatives
        if here:
            return (
                f"the equilibrium is unstable there, with {here} negative eigenvalue{'s' * (here > 1)} of the stiffness"
            )
        move = size * system.response(rest, state.time)
        scale = model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)
        for part in _AHEAD:
            matrix.update(system.problem, part * move)
            there = stability.look()
            if there.negatives or there.nearest < _ZERO * scale:
                return "it is a limit point: the stiffness becomes singular there"
    except (NotConverged, np.linalg.LinAlgError, PETSc.Error):
        return "it may be a limit point: the stiffness cannot be factorised there"
    finally:
        for thing in (system, stability, matrix):
            thing.destroy()
    return "the stiffness shows no limit point: a smaller static.min_step or a larger solver.max_newton may help"


def _text(model: Model, state: State, free: list[np.ndarray]) -> str:
    """Rigid-body motions first, then mechanisms."""
    if not free:
        return ""
    rigid = _rigid(model, state, free)
    many = f"{len(free)}{' or more' * (len(free) == _MOST)}"
    text = f". The stiffness leaves {many} motion{'s' * (len(free) > 1)} free"
    if rigid == len(free):
        text += ", of the truss as a rigid body"
    elif rigid:
        text += f", {rigid} of them of the truss as a rigid body"
    told = "; ".join(_nodes(model, motion) for motion in free[:_TOLD])
    return f"{text}: {told}. Add supports or bars that prevent them"


def _rigid(model: Model, state: State, free: list[np.ndarray]) -> int:
    """How many rigid-body motions are combinations of free ones. Collective."""
    x = state.position
    centre = model.comm.allreduce(x.sum(axis=0)) / model.mesh.n_nodes
    arms = (x - centre) / model.length
    motions = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)] + [np.cross(axis, arms) for axis in np.eye(3)]
    rigid = np.stack(motions)
    gram = model.comm.allreduce(np.einsum("inc,jnc->ij", rigid, rigid))
    values, vectors = np.linalg.eigh(gram)
    # a straight rod has five
    keep = values > 1e-12 * values[-1]
    basis = np.einsum("ij,inc->jnc", vectors[:, keep] / np.sqrt(values[keep]), rigid)
    shares = model.comm.allreduce(np.einsum("inc,jnc->ij", basis, np.stack(free)))
    return int((np.linalg.svd(shares, compute_uv=False) > 1.0 - 1e-6).sum())


def _nodes(model: Model, motion: np.ndarray) -> str:
    """The nodes that a motion moves most, and where to. Collective."""
    size = np.linalg.norm(motion, axis=1)
    largest = max(model.comm.allgather(float(size.max(initial=0.0))))
    at = np.flatnonzero(size > _MOVES * largest)
    ids = model.mesh.node_ids[at]
    # the node that moves most, and the lowest ones of those that are named; a motion may move all nodes
    most = at[np.lexsort((ids, -size[at].round(9)))][:1]
    mine = [(-float(size[k].round(9)), int(model.mesh.node_ids[k]), motion[k] / size[k]) for k in most]
    moved = sorted((entry[:2], entry[2]) for part in model.comm.allgather(mine) for entry in part)
    (_, first), direction = moved[0]
    lowest = sorted(node for part in model.comm.allgather(np.sort(ids)[: _NAMED + 1].tolist()) for node in part)
    others = [node for node in lowest if node != first][:_NAMED]
    more = model.comm.allreduce(len(at)) - 1 - len(others)
    way = "(" + ", ".join(f"{part:.2g}" for part in direction.round(3) + 0.0) + ")"
    text = f"node {first} along {way}"
    if others:
        text += f", with node{'s' * (len(others) > 1)} " + ", ".join(map(str, others))
    return text + (f" and {more} more" if more else "")
