"""The nodes of a block and their bars in a step of a batch: moved, pulled, and finished.

Blocks are those of the order of nodes; the bars of a block reach its own nodes and those of some blocks behind it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..integrators._leapfrog import advance, advance_loaded, advance_solved, drift, move, solve
from ..mechanics.compiled import borrowing, calls, kernel
from ..mechanics.elements import PULLED, clear_energies, sum_energies
from ..mechanics.runs import PAGE, join_components, new_rows, split_components
from ..mechanics.tuples import ROW
from ..mesh.ordering import NODE_BLOCK
from .batch_supports import add_springs
from .ledger_loops import INTERNAL, REACTIONS, EndArrays, add_drags, add_loads, add_sparse_forces, spread


class BarArrays(NamedTuple):
    """The bars of a batch, by sections.

    Attributes
    ----------
    sections : (s, 3) int64, addresses of the :class:`~pfem_petsc.mechanics.elements.PulledBars` of each section, and of
        the loops of its law, see :func:`~pfem_petsc.mechanics.elements.batch_pulls`
    parts : (s, blocks + 2) int64, the first chunk of each block of nodes, of the bars that other ranks count, and the
        end
    padded_parts : the same of groups of padded runs; (s, 0) if not all sections have such
    places, n_energies : (s, k) and (s,) int64, see :func:`~pfem_petsc.mechanics.elements.sum_energies`
    work_rows : number of rows of the largest workspace
    keeps, can_break : whether laws have a history; whether bars of the case can break, the same on all ranks
    spring_place : index of the energy of springs among those of bars
    reach : how many blocks of nodes beyond its own the bars of a block reach
    meeting : the first block that waits for messages
    ends, watched : see ``Bars``
    planes, pulls : (3 stride,), positions and forces by components, of a window of the nodes
    """

    sections: np.ndarray
    parts: np.ndarray
    padded_parts: np.ndarray
    places: np.ndarray
    n_energies: np.ndarray
    work_rows: int
    keeps: bool
    can_break: bool
    spring_place: int
    reach: int
    meeting: int
    ends: np.ndarray
    watched: np.ndarray
    planes: np.ndarray
    pulls: np.ndarray


class NodeArrays(NamedTuple):
    """Constant arrays at the nodes; ``damping`` (0,) and ``external`` (0, 3) if there are none; ``stiffness`` (n,) of
    the balance and its inverse; ``support_starts`` (blocks + 1,) the first prescribed component of each block of nodes,
    which are sorted by node."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    inverses: np.ndarray
    external: np.ndarray
    support_nodes: np.ndarray
    support_components: np.ndarray
    support_positions: np.ndarray
    support_starts: np.ndarray


class BlockArrays(NamedTuple):
    """What the passes over blocks of nodes share: numbers of the scheme, see
    :mod:`~pfem_petsc.integrators._leapfrog`; positions ``x`` (local, 3) and velocities at half steps ``half`` (n, 3);
    ``inverses`` (n,) of the stiffness; ``factors``, ``speeds`` and ``drag``
    (3 NODE_BLOCK,) buffers of a block, the last one empty without damping; for prescribed components the increments
    ``held`` (k,) [m] and ``load`` (k,), the forces that would move them [N]; reactions ``support`` (n, 3) [N];
    ``lanes``, the sums of the balance, see :mod:`~pfem_petsc.stepping.ledger_loops`; and room for ``ends`` of steps."""

    h: float
    alpha: float
    eta: float
    x: np.ndarray
    half: np.ndarray
    inverses: np.ndarray
    factors: np.ndarray
    speeds: np.ndarray
    drag: np.ndarray
    held: np.ndarray
    load: np.ndarray
    support: np.ndarray
    lanes: np.ndarray
    ends: EndArrays


class StateArrays(NamedTuple):
    """Arrays (n, 3) of the state, and the increments ``u`` of the balance. Wall forces are zero except at the nodes
    that touch walls; support forces are written at prescribed components alone."""

    f: np.ndarray
    a: np.ndarray
    v: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    u: np.ndarray


@borrowing
def move_block(block, shared, f, padded, bars, base):
    """Move the nodes of a block, and set their forces to zero; with ``padded`` runs those of :func:`split_block`."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where = shared.x[first:last].reshape(-1)
    move(where, shared.h, shared.half[first:last].reshape(-1))
    if padded:
        split_block(first, last, shared.x, bars.planes, bars.pulls, base)
        return
    sums = f[first:last].reshape(-1)
    for j in range(len(sums)):
        sums[j] = 0.0


@borrowing
def split_block(first, last, x, planes, pulls, base):
    """Write the positions of nodes [first, last) to ``planes`` (3 stride,), which begin at node ``base``, and set their
    forces in ``pulls`` (3 stride,) to zero."""
    stride = len(planes) // 3
    split_components(x, first, last - first, planes, stride, base)
    for c in range(3):
        part = pulls[c * stride + first - base : c * stride + last - base]
        for i in range(len(part)):
            part[i] = 0.0


@borrowing
def join_block(block, n, pulls, base, f, start):
    """Write the forces of the nodes of a block from ``pulls``."""
    first = NODE_BLOCK * block
    join_components(pulls, base, first, f[first - start : min(first + NODE_BLOCK, n) - start])


@borrowing
def hold_still(block, nodes, shared, f, inverse):
    """Write the increments of the prescribed components of a block without damping and contact to ``shared.held`` (k,),
    and their reactions to ``shared.support`` (owned, 3) [N]; set their inverse stiffness to zero in ``inverse`` (3 m,).
    This array and the forces ``f`` (m, 3) are those of the block."""
    components, positions, external = nodes.support_components, nodes.support_positions, nodes.external
    held, support, x, half = shared.held, shared.support, shared.x, shared.half
    origin, loaded = NODE_BLOCK * block, len(external) > 0
    for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
        i, c = nodes.support_nodes[k], components[k]
        stiffness = nodes.stiffness[i]
        pull = f[i - origin, c]
        force = external[i, c] - pull if loaded else -pull
        free = stiffness * (force * (1.0 / stiffness))
        held[k] = positions[k] - (x[i, c] + shared.h * half[i, c])
        support[i, c] = stiffness * held[k] - free
        inverse[3 * (i - origin) + c] = 0.0


@borrowing
def advance_block(block, nodes, shared, f, start):
    """Finish the step of a block without walls and damping in one pass: forces alone determine its increments."""
    h, alpha, eta, half, held, support = shared.h, shared.alpha, shared.eta, shared.half, shared.held, shared.support
    lanes = shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(half))
    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
    components = nodes.support_components
    here, factor = shared.speeds[: 3 * (last - first)], shared.factors[: 3 * (last - first)]
    forces = f[first - start : last - start]
    spread(shared.inverses[first:last], factor)
    hold_still(block, nodes, shared, forces, factor)
    force, ahead = forces.reshape(-1), half[first:last].reshape(-1)
    if len(nodes.external) > 0:
        load = nodes.external[first:last].reshape(-1)
        advance_loaded(force, load, factor, (alpha, eta, h), ahead, here, lanes[INTERNAL])
        add_loads(load, here, lanes)
    else:
        advance(force, factor, alpha, eta, h, ahead, lanes[INTERNAL])
    for k in range(begin, end):
        half[nodes.support_nodes[k], components[k]] += h * (alpha * held[k])
    add_sparse_forces(begin, end, nodes.support_nodes, components, support, lanes[REACTIONS])


@borrowing
def solve_block(block, nodes, shared, f, start, free, u):
    """Compute the increments ``u`` (3 m,) of a block without contact, and its ``free`` positions (3 m,); those of its
    prescribed components are written to ``shared`` too."""
    h = shared.h
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where, speed = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    force = f[first - start : last - start].reshape(-1)
    factor = shared.factors[: len(u)]
    if len(nodes.external) > 0:
        given = nodes.external[first:last].reshape(-1)
        for j in range(len(u)):
            u[j] = given[j] - force[j]
    else:
        for j in range(len(u)):
            u[j] = -force[j]
    if len(nodes.damping) > 0:
        spread(nodes.damping[first:last], factor)
        for j in range(len(u)):
            u[j] -= factor[j] * speed[j]
    spread(shared.inverses[first:last], factor)
    solve(factor, where, h, speed, u, free)
    for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
        i = nodes.support_nodes[k]
        j = 3 * (i - first) + nodes.support_components[k]
        shared.load[k] = nodes.stiffness[i] * u[j]
        drifted = where[j] + h * speed[j]
        u[j] = shared.held[k] = nodes.support_positions[k] - drifted
        free[j] = drifted + u[j]


@borrowing
def predict(block, shared, predictor):
    """Write the positions to which the nodes of a block move without forces to ``predictor`` (n, 3)."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where, speed = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    drift(where, shared.h, speed, predictor[first:last].reshape(-1))


@borrowing
def place_block(block, shared, u, free):
    """Write the positions that the nodes of a block reach with increments ``u`` to ``free``, (3 m,) both."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    drift(shared.x[first:last].reshape(-1), shared.h, shared.half[first:last].reshape(-1), free)
    for j in range(len(u)):
        free[j] += u[j]


@borrowing
def finish_block(block, nodes, shared, f, start, contact, u):
    """Finish the step of a block from its increments ``u`` (3 m,): reactions, velocities half a step later, and powers.

    The velocities of the balance remain in ``shared.speeds``.
    """
    alpha, eta, support, lanes = shared.alpha, shared.eta, shared.support, shared.lanes
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    begin, end = nodes.support_starts[block], nodes.support_starts[block + 1]
    damped = len(shared.drag) > 0
    for k in range(begin, end):
        i, c = nodes.support_nodes[k], nodes.support_components[k]
        stiffness = nodes.stiffness[i]
        support[i, c] = stiffness * u[3 * (i - first) + c] - shared.load[k] - contact[i, c]
    ahead, here = shared.half[first:last].reshape(-1), shared.speeds[: len(u)]
    force = f[first - start : last - start].reshape(-1)
    advance_solved(u, force, (alpha, eta, shared.h), ahead, here, lanes[INTERNAL])
    add_sparse_forces(begin, end, nodes.support_nodes, nodes.support_components, support, lanes[REACTIONS])
    if len(nodes.external) > 0:
        add_loads(nodes.external[first:last].reshape(-1), here, lanes)
    if damped:
        add_drags(nodes.damping[first:last], here, shared.drag, lanes)


_pull = calls(PULLED)


@borrowing
def pull(x, bars, block, f, work):
    """Add the forces of the bars of a block of nodes, or, after the last one, of those that other ranks count; results
    as those of :data:`~pfem_petsc.mechanics.elements.PULLED`."""
    failed, shortened, broke = -1, False, 0
    for s in range(len(bars.sections)):
        begun, ended = bars.parts[s, block], bars.parts[s, block + 1]
        if begun < ended:
            address, loop = bars.sections[s, 0], bars.sections[s, 1]
            at, short, more = _pull(loop, (x, address, begun, ended, f, work[s]))
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
    return failed, shortened, broke


@borrowing
def pull_padded(x, bars, base, block, work, counts):
    """Add the same forces by padded runs to ``bars.pulls``, and energies to ``work`` if it ``counts`` them; ``base`` is
    the first node there."""
    failed, shortened, broke = -1, False, 0
    for s in range(len(bars.sections)):
        begun, ended = bars.padded_parts[s, block], bars.padded_parts[s, block + 1]
        if begun < ended:
            address, loop = bars.sections[s, 0], bars.sections[s, 2]
            at, short, more = _pull(loop, (x, address, np.int64(base), begun, ended, work[s], counts))
            failed = at if failed < 0 else failed
            shortened = shortened or short
            broke += more
    return failed, shortened, broke


@borrowing
def pull_again(x, n_blocks, bars, springs, f, work, sums):
    """Compute all forces in the order of a step; ``sums`` (4,) of springs are overwritten."""
    flat = f.reshape(-1)
    for j in range(len(flat)):
        flat[j] = 0.0
    pull(x, bars, n_blocks, f, work)
    for block in range(n_blocks):
        pull(x, bars, block, f, work)
    add_springs(0, len(springs.nodes), springs, x, f, 0, sums)


@kernel
def new_work(sections, rows):
    """Return workspaces of some rows for each section, each at its place in a page; not initialised."""
    pages = -(-rows * ROW // PAGE)
    return new_rows(sections * pages)[: sections * pages * PAGE].reshape(sections, pages * PAGE)


@borrowing
def clear_all_energies(bars, work):
    """Set the sums of energies of all sections to zero."""
    for s in range(len(bars.sections)):
        clear_energies(work[s], bars.places[s, : bars.n_energies[s]])


@borrowing
def sum_all_energies(bars, work, energies):
    """Write the energies of the bars of all sections."""
    energies[:] = 0.0
    for s in range(len(bars.sections)):
        sum_energies(work[s], bars.places[s, : bars.n_energies[s]], energies)
