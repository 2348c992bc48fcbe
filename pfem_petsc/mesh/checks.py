"""Checks of a mesh on slabs, before it is distributed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from .exchange import Router
from .slab import MeshSlab, slab_of

__all__ = ["LARGE", "SHORT", "check_mesh"]

SHORT = 1e-6
"""Bars shorter than this fraction of the mean length are reported as suspicious."""

LARGE = 1e150
"""Coordinates [m] of at least this size are refused, because their squares overflow."""

_SHOWN = 5

_PIECE = 1 << 18  # number of bars that are checked at a time, to keep temporary arrays small

_NO_LINES = (
    "; if there are physical groups, Gmsh saves nothing else: put the lines into one "
    '(Physical Curve("bars") = {:}), or save all (Mesh.SaveAll = 1)'
)


def check_mesh(slab: MeshSlab, comm: MPI.Comm) -> list[str]:
    """Refuse a mesh that cannot be simulated. Collective.

    Nodes and bars are named by their numbers in the mesh, from 0. A structured mesh is valid by construction and is not
    checked.

    Returns
    -------
    warnings : list of str
        Those of the slab, and about suspicious bars (far shorter than the others); equal on all ranks.

    Raises
    ------
    InputError
        On all ranks, for a mesh without nodes or bars, coordinates that are not finite, bar ends that do not exist,
        bars of zero length, several bars between the same two nodes, or nodes without bars.
    """
    warnings = comm.bcast(slab.warnings if comm.rank == 0 else None)
    if slab.structured:
        return warnings
    if slab.n_nodes == 0 or slab.n_bars == 0:
        hint = _NO_LINES if slab.source.endswith(".msh") and slab.n_nodes else ""
        raise InputError(f"{slab.source}: {slab.n_nodes} nodes and {slab.n_bars} bars: nothing to simulate{hint}")
    _check_points(slab, comm)
    _check_ends(slab, comm)
    used, length = _lengths(slab, comm)
    _check_bare_nodes(slab, comm, used)
    warnings = warnings + _check_lengths(slab, comm, length)
    del used, length
    _check_duplicates(slab, comm)
    return warnings


def _lengths(slab: MeshSlab, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return which nodes of the slab bars end at, (nodes here,) bool, and the lengths [m] of its bars, in pieces.
    Collective."""
    used, length = np.zeros(len(slab.points), bool), np.empty(len(slab.bars))
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        bars = slab.bars[start : start + _PIECE]
        # Each end of a bar is sent to the rank whose slab contains it, which then knows all nodes in use.
        ends, place = np.unique(bars, return_inverse=True)
        asking = Router(comm, slab_of(ends, slab.n_nodes, comm.size))
        asked = asking.send(ends) - slab.first_node
        used[asked] = True
        points = asking.reply(slab.points[asked])
        place = place.reshape(-1, 2)
        with np.errstate(over="ignore"):
            across = points[place[:, 1]]
            across -= points[place[:, 0]]
            length[start : start + _PIECE] = np.sqrt(np.einsum("ij,ij->i", across, across))
    return used, length


def _check_points(slab: MeshSlab, comm: MPI.Comm) -> None:
    bad = np.flatnonzero(~(np.abs(slab.points) < LARGE).all(axis=1))
    lines = [f"node {slab.first_node + i} at ({', '.join(f'{x:g}' for x in slab.points[i])})" for i in bad[:_SHOWN]]
    _refuse(slab, comm, lines, len(bad), f"nodes have coordinates that are not numbers below {LARGE:g}", "correct them")


def _check_ends(slab: MeshSlab, comm: MPI.Comm) -> None:
    bad = np.flatnonzero(((slab.bars < 0) | (slab.bars >= slab.n_nodes)).any(axis=1))
    lines = [_bar(slab, i) for i in bad[:_SHOWN]]
    remedy = f"nodes are numbered from 0 to {slab.n_nodes - 1}"
    _refuse(slab, comm, lines, len(bad), "bars have an end that does not exist", remedy)
    bad = np.flatnonzero(slab.bars[:, 0] == slab.bars[:, 1])
    lines = [_bar(slab, i) for i in bad[:_SHOWN]]
    _refuse(slab, comm, lines, len(bad), "bars start and end at the same node", "remove them" + _way(slab))


def _check_bare_nodes(slab: MeshSlab, comm: MPI.Comm, used: np.ndarray) -> None:
    bad = np.flatnonzero(~used)
    lines = [f"node {slab.first_node + i}" for i in bad[:_SHOWN]]
    remedy = "remove them: a node without bars has neither mass nor stiffness" + _way(slab)
    if slab.source.endswith(".msh"):
        remedy += (
            " (Gmsh saves each point of a physical group: these are points that no line in a group ends at; points at "
            "the same place are merged by `Coherence;`)"
        )
    _refuse(slab, comm, lines, len(bad), "nodes belong to no bar", remedy)


def _check_lengths(slab: MeshSlab, comm: MPI.Comm, length: np.ndarray) -> list[str]:
    bad = np.flatnonzero(~((length > 0.0) & (length < np.inf)))
    lines = [f"{_bar(slab, i)}, length {length[i]:g}" for i in bad[:_SHOWN]]
    remedy = "merge the nodes at its ends, or correct their positions" + _way(slab)
    _refuse(slab, comm, lines, len(bad), "bars have a length that is zero or overflows double precision", remedy)
    mean = comm.allreduce(float(length.sum())) / slab.n_bars
    short = np.flatnonzero(length < SHORT * mean)
    lines = [f"{_bar(slab, i)}, length {length[i]:g} m" for i in short[:_SHOWN]]
    text = _sentence(comm, lines, len(short), f"bars are far shorter than the mean length {mean:g} m")
    return [f"{slab.source}: {text}; the explicit time step decreases with the shortest bar"] if text else []


def _check_duplicates(slab: MeshSlab, comm: MPI.Comm) -> None:
    """Refuse bars between the same two nodes: the rank whose slab has the lower end sorts them next to each other."""
    key = _pairs_of_ends(slab, comm)
    key.sort()
    if not comm.allreduce(int((key[1:] == key[:-1]).any())):
        return
    # the bars are named by sending all of them once more, with their numbers
    key = slab.bars.min(axis=1).astype(np.int64)
    router = Router(comm, slab_of(key, slab.n_nodes, comm.size))
    key *= slab.n_nodes
    key += slab.bars.max(axis=1)
    key = router.send(key)
    order = np.argsort(key, kind="stable")
    key = key[order]
    again = np.flatnonzero(key[1:] == key[:-1])
    numbers = router.send(np.arange(slab.first_bar, slab.first_bar + len(slab.bars)))
    pairs = sorted((int(numbers[order[i]]), int(numbers[order[i + 1]]), int(key[i])) for i in again[:1000])
    lines = []
    for one, other, ends in pairs[:_SHOWN]:
        lines.append(f"bars {one} and {other} (nodes {ends // slab.n_nodes} and {ends % slab.n_nodes})")
    what = "bars join the same two nodes as another bar"
    _refuse(slab, comm, lines, len(again), what, "keep one of each, with the sum of the areas" + _way(slab))


def _pairs_of_ends(slab: MeshSlab, comm: MPI.Comm) -> np.ndarray:
    """Return a number for the two ends of each bar whose lower end is in this rank's slab of nodes. Collective."""
    arriving = np.zeros(comm.size, np.int64)
    for start in range(0, len(slab.bars), _PIECE):
        lower = slab.bars[start : start + _PIECE].min(axis=1)
        arriving += np.bincount(slab_of(lower, slab.n_nodes, comm.size), minlength=comm.size)
    comm.Allreduce(MPI.IN_PLACE, arriving)
    keys, at = np.empty(arriving[comm.rank], np.int64), 0
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        bars = slab.bars[start : start + _PIECE].astype(np.int64)
        lower = bars.min(axis=1)
        piece = Router(comm, slab_of(lower, slab.n_nodes, comm.size)).send(lower * slab.n_nodes + bars.max(axis=1))
        keys[at : at + len(piece)] = piece
        at += len(piece)
    return keys


def _way(slab: MeshSlab) -> str:
    """Return the command that mends a mesh file; nothing for meshes from elsewhere."""
    file = Path(slab.source)
    return f"; python -m pfem_petsc mesh clean {file} {file.stem}_clean.h5" if file.is_file() else ""


def _bar(slab: MeshSlab, i: int) -> str:
    return f"bar {slab.first_bar + i} (nodes {slab.bars[i, 0]} and {slab.bars[i, 1]})"


def _sentence(comm: MPI.Comm, lines: list[str], count: int, what: str) -> str:
    """Return what all ranks found: the count, ``what``, and the first few; empty if nothing. Collective."""
    total = comm.allreduce(count)
    if total == 0:
        return ""
    found = [line for rank_lines in comm.allgather(lines) for line in rank_lines]
    more = ", ..." if total > _SHOWN else ""
    return f"{total} {what}: {', '.join(found[:_SHOWN])}{more}"


def _refuse(slab: MeshSlab, comm: MPI.Comm, lines: list[str], count: int, what: str, remedy: str) -> None:
    """Raise the same InputError on all ranks if any rank found something. Collective."""
    text = _sentence(comm, lines, count, what)
    if text:
        raise InputError(f"{slab.source}: {text}; {remedy}")
