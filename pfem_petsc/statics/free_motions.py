"""Motions of a truss without stiffness: rigid-body motions and mechanisms, with the nodes that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..contact.transform import Transform
from ..errors import NotConverged
from ..solvers.matrix import HessianMatrix
from ..stepping.problem import StepProblem
from .scheme import Equilibrium
from .stability import LARGEST, Stability

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["free_motions", "names_motions"]

_ZERO = 1e-11  # of the largest stiffness of a node; limit points that steps come close to have 1e-6 and more
_MOST = 8  # motions that are looked at
_TOLD = 3
_NAMED = 4  # nodes besides the one that moves most
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
