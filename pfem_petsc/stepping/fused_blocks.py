"""The passes of the fused loop over a block of nodes: move it, solve its balances, and finish its step.

``nodes`` are a :class:`~pfem_petsc.stepping.fused_arrays.NodeArrays`, ``shared`` a
:class:`~pfem_petsc.stepping.fused_arrays.BlockArrays`. Other arrays have a row for each owned node, except buffers of a
block; the internal forces ``f`` begin at node ``start``, because steps whose forces nothing reads keep those of one
block only.
"""

from __future__ import annotations

from ..integrators._leapfrog import advance, advance_loaded, centre, kick, move
from ..mechanics.compiled import borrowing
from ..mechanics.planes import join_planes, split_planes
from ..mesh.ordering import NODE_BLOCK
from .balance_loops import INTERNAL, REACTIONS, add_drags, add_loads, add_powers, add_sparse_forces
from .book_loops import spread
from .node_loops import hold_still

__all__ = ["advance_block", "finish_block", "join_block", "move_block", "solve_block", "split_block"]


@borrowing
def move_block(block, n, x, h, half, f, light, planes, pulls, base):
    """Move the nodes of a block, and set their forces to zero; in ``light`` steps those of :func:`split_block`."""
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, n)
    where = x[first:last].reshape(-1)
    move(where, h, half[first:last].reshape(-1))
    if light:
        split_block(first, last, x, planes, pulls, base)
        return
    sums = f[first:last].reshape(-1)
    for j in range(len(sums)):
        sums[j] = 0.0


@borrowing
def split_block(first, last, x, planes, pulls, base):
    """Write the positions of nodes [first, last) to ``planes`` (3 stride,), which begin at node ``base``, and set their
    forces in ``pulls`` (3 stride,) to zero."""
    stride = len(planes) // 3
    split_planes(x, first, last - first, planes, stride, base)
    for c in range(3):
        part = pulls[c * stride + first - base : c * stride + last - base]
        for i in range(len(part)):
            part[i] = 0.0


@borrowing
def join_block(block, n, pulls, base, f, start):
    """Write the forces of the nodes of a block from ``pulls``."""
    first = NODE_BLOCK * block
    join_planes(pulls, len(pulls) // 3, base, first, min(NODE_BLOCK, n - first), f, first - start)


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
    hold_still(
        begin,
        end,
        first,
        nodes.support_nodes,
        components,
        nodes.support_positions,
        nodes.mass,
        nodes.external,
        forces,
        shared.x,
        half,
        h,
        alpha,
        factor,
        held,
        support,
    )
    force, ahead = forces.reshape(-1), half[first:last].reshape(-1)
    if len(nodes.external) > 0:
        load = nodes.external[first:last].reshape(-1)
        advance_loaded(force, load, factor, alpha, eta, h, ahead, here, lanes[INTERNAL])
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
    h, alpha, eta = shared.h, shared.alpha, shared.eta
    first = NODE_BLOCK * block
    last = min(first + NODE_BLOCK, len(shared.half))
    where, speed = shared.x[first:last].reshape(-1), shared.half[first:last].reshape(-1)
    force = f[first - start : last - start].reshape(-1)
    factor = shared.factors[: len(u)]
    damped = len(nodes.damping) > 0
    if len(nodes.external) > 0:
        given = nodes.external[first:last].reshape(-1)
        for j in range(len(u)):
            u[j] = given[j] - force[j]
    else:
        for j in range(len(u)):
            u[j] = -force[j]
    if damped:
        spread(nodes.damping[first:last], factor)
        for j in range(len(u)):
            u[j] -= factor[j] * speed[j]
    spread(shared.inverses[first:last], factor)
    for j in range(len(u)):
        u[j] *= factor[j]
        free[j] = where[j] + h * speed[j]
    for k in range(nodes.support_starts[block], nodes.support_starts[block + 1]):
        i = nodes.support_nodes[k]
        j = 3 * (i - first) + nodes.support_components[k]
        shared.load[k] = (alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)) * u[j]
        u[j] = shared.held[k] = nodes.support_positions[k] - free[j]
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
        stiffness = alpha * nodes.mass[i] + (eta * nodes.damping[i] if damped else 0.0)
        support[i, c] = stiffness * u[3 * (i - first) + c] - shared.load[k] - contact[i, c]
    ahead, here = shared.half[first:last].reshape(-1), shared.speeds[: len(u)]
    kick(u, alpha, shared.h, ahead)
    centre(u, eta, ahead, here)
    add_powers(f[first - start : last - start].reshape(-1), here, lanes[INTERNAL])
    add_sparse_forces(begin, end, nodes.support_nodes, nodes.support_components, support, lanes[REACTIONS])
    if len(nodes.external) > 0:
        add_loads(nodes.external[first:last].reshape(-1), here, lanes)
    if damped:
        add_drags(nodes.damping[first:last], here, shared.drag, lanes)
