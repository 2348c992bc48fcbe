"""The phases of a step of central differences, each over all nodes of a rank: move, springs, balance, supports,
reactions, and the sums that the energy balance needs.

Positions, velocities at half steps, increments and forces lie by components, (3, n) or longer rows, so that loops are
vectorised. With velocities at half steps, x1 = x0 + h half, the balance (m/h^2 + c/(2h)) u = f_ext - f_int - c half
gives the increment u beyond x0 + h half; then half1 = half + u/h, and velocity and acceleration of the balance are
half1 - u/(2h) and u/h^2. Supports and contact correct u at some nodes, by :func:`displace`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..mechanics.compiled import add_freely, addressed, inlined, kernel, record

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works of the energy balance [J], in this order; the first includes supports."""

EXTERNAL, CONTACT, DAMPING, INERTIAL, INTERNAL = range(len(WORKS))
KINETIC = len(WORKS)
SUPPORTS, LOADS, DRAGS = range(3)
"""Rows of the forces in a balance."""

FAILED, LOST = -1, -2
"""Results of calls of Python: a failure of the simulation, any other error."""

NEEDS_ENERGIES, HOLDS, DONE, PASSED, RECORDED, MPI_ERROR = range(6)
CHANGED, SHORTENED, COLLAPSED, TURNED, INFEASIBLE, WHY, UNSOLVED, NEAR, PRESSING = range(6, 15)
"""Numbers of the course of a call: whether a step needs energies; whether a condition holds here, and after
:func:`~pfem_petsc.stepping.compiled_loop.agree` on any rank; numbers of steps made, of those that other ranks make too,
of which this one only sends messages after a failure, and of shares of rows; the error code of MPI. Of the last step:
the number of bars that changed their state of rupture; whether bars need a look for one that has gone through zero
length; the first bar that collapsed, the first that went through zero length, and the first node of ContactNodes that
walls leave no place, or -1, and why; what a call of Python returned; the number of nodes beyond walls or that rebound,
in ContactNodes; and of nodes with contact forces."""


@record
class Nodes(NamedTuple):
    """Constants of the owned nodes.

    Attributes
    ----------
    mass : (n,) [kg]; damping : (n,) [kg/s], (0,) without
    stiffness, inverse : (n,) m/h^2 + c/(2h) [N/m] and its inverse
    external : (3, n) [N], (3, 0) without
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    inverse: np.ndarray
    external: np.ndarray


@record
class Motion(NamedTuple):
    """What moves: the step h [s]; positions and internal forces of local nodes, (3, stride); of owned nodes velocities
    at half steps, and increments, (3, n); and contact forces (n, 3)."""

    h: float
    x: np.ndarray
    half: np.ndarray
    u: np.ndarray
    f: np.ndarray
    contact: np.ndarray


@record
class Prescribed(NamedTuple):
    """Prescribed components (k,), sorted by node.

    Attributes
    ----------
    nodes, components : (k,)
    positions : (k,) that they reach by the balance [m]
    half : (k,) velocities half a step before it [m/s]
    u, load : (k,) their increments [m], and the forces that would move them [N]
    reaction : (n, 3) [N], written at these components
    """

    nodes: np.ndarray
    components: np.ndarray
    positions: np.ndarray
    half: np.ndarray
    u: np.ndarray
    load: np.ndarray
    reaction: np.ndarray


@record
class MovingSupports(NamedTuple):
    """Prescribed components that move in some steps.

    Their velocities at half steps are differences of the positions of their motions, so works are over the ways
    between these. Velocities, accelerations, inertia, damping and reactions are those of the motions themselves; they
    differ from the scheme's by its errors, which are added.

    Attributes
    ----------
    at, columns : (p,) which of the prescribed components, and the columns of their motions
    origins : (p,) positions without displacement [m]
    motions : (t, 3, m) displacements, velocities and accelerations of all motions at the start of the first step, at
        the end of each, and of one more
    """

    at: np.ndarray
    columns: np.ndarray
    origins: np.ndarray
    motions: np.ndarray


@record
class GroundSprings(NamedTuple):
    """Springs to the ground at ``nodes`` (m,), see :class:`~pfem_petsc.mechanics.springs.Springs`."""

    nodes: np.ndarray
    stiffness: np.ndarray
    anchors: np.ndarray


@record
class StepSums(NamedTuple):
    """Of a step: ``works`` (5,) of its balance over the step [J]; ``forces`` (3, 3) of supports, loads and dampers
    [N]; ``springs`` (4,) force of springs to the ground [N] and their energy [J]; ``jumps`` (2, 3) by how much the
    momenta of moving supports at the half step and at the end exceed the scheme's [kg m/s]; ``ends`` (6,) works over
    the last half of the step, and kinetic energy [J]; ``momenta`` (3, 3) momentum, angular momentum and mass times
    position."""

    works: np.ndarray
    forces: np.ndarray
    springs: np.ndarray
    jumps: np.ndarray
    ends: np.ndarray
    momenta: np.ndarray


def new_sums() -> StepSums:
    """Return sums of a step, zero."""
    return StepSums(np.zeros(5), np.zeros((3, 3)), np.zeros(4), np.zeros((2, 3)), np.zeros(6), np.zeros((3, 3)))


@inlined
def numerical_dissipation(inertial, internal, stored, excess, lost):
    """Return what the scheme dissipates [J], of any steps: the works of inertia and of the forces of bars, less the
    growth of the ``stored`` energy of nodes and bars, the ``excess`` of the work of contact on nodes over that of
    moving walls, and what friction and impact took, ``lost``."""
    return inertial + internal - stored - excess - lost


@inlined
def clear_vector(values):
    """Set numbers to zero; assignments to slices take long to compile."""
    for i in range(len(values)):
        values[i] = 0.0


@inlined
def clear_rows(rows):
    """Set the numbers of some rows to zero."""
    for k in range(len(rows)):
        for c in range(rows.shape[1]):
            rows[k, c] = 0.0


@kernel
def move(x, h, half):
    """Move the owned nodes by h ``half``."""
    for c in range(3):
        where, speed = x[c], half[c]
        for i in range(len(speed)):
            where[i] += h * speed[i]


@addressed
def add_springs(s, step):
    """Add the forces of springs to the ground."""
    springs, x, f, sums = s.springs, s.motion.x, s.motion.f, s.sums.springs
    clear_vector(sums)
    for k in range(len(springs.nodes)):
        i = springs.nodes[k]
        for c in range(3):
            force = 0.0
            for d in range(3):
                force += springs.stiffness[k, c, d] * (x[d, i] - springs.anchors[k, d])
            f[c, i] += force
            sums[c] += force
            sums[3] += 0.5 * force * (x[c, i] - springs.anchors[k, c])


@addressed
def place_supports(s, step):
    """Set the positions that moving components reach one step after a step."""
    moving = s.moving
    for p in range(len(moving.at)):
        s.held.positions[moving.at[p]] = moving.origins[p] + moving.motions[step + 2, 0, moving.columns[p]]


@inlined
def _advance(f, external, inverse, h, half, u):
    """Solve the balances of a component with the forces of bars and loads, None for none, advance ``half``, and write
    the increments; return the powers of both, and the sum of the loads."""
    rate, eta, power, given, total = 1.0 / h, 0.5 / h, 0.0, 0.0, 0.0
    for i in range(len(half)):
        force = -f[i]
        if external is not None:
            force += external[i]
        u[i] = force * inverse[i]
        half[i] += rate * u[i]
        v = half[i] - eta * u[i]
        power = add_freely(power, f[i] * v)
        if external is not None:
            given = add_freely(given, external[i] * v)
            total = add_freely(total, external[i])
    return power, given, total


@inlined
def _advance_damped(f, damping, inverse, h, half, u):
    """The same with all forces in ``u``, in whose place the increments are written; return the powers of the forces of
    bars and of what dampers take, and the sum of this."""
    rate, eta, power, taken, total = 1.0 / h, 0.5 / h, 0.0, 0.0, 0.0
    for i in range(len(half)):
        u[i] *= inverse[i]
        half[i] += rate * u[i]
        v = half[i] - eta * u[i]
        power = add_freely(power, f[i] * v)
        taken = add_freely(taken, damping[i] * (v * v))
        total = add_freely(total, damping[i] * v)
    return power, taken, total


@inlined
def _forces(f, external, damping, half, u):
    """Write all forces of a component to ``u``: those of bars, loads (0,) if there are none, and dampers."""
    for i in range(len(u)):
        u[i] = -f[i]
    for i in range(len(external)):
        u[i] += external[i]
    for i in range(len(damping)):
        u[i] -= damping[i] * half[i]


@inlined
def _load(external, h, half, u):
    """Return sum and power of loads."""
    eta, total, power = 0.5 / h, 0.0, 0.0
    for i in range(len(external)):
        total = add_freely(total, external[i])
        power = add_freely(power, external[i] * (half[i] - eta * u[i]))
    return total, power


@cache
def balancing(loaded: bool, damped: bool) -> Any:
    """Make the phase that solves the balances of all nodes without supports and contact, and begins the sums of the
    step."""

    @addressed
    def balance(s, step):
        nodes, motion, held, works, forces = s.nodes, s.motion, s.held, s.sums.works, s.sums.forces
        h, f, half, u, external = motion.h, motion.f, motion.half, motion.u, nodes.external
        clear_vector(works)
        clear_rows(forces)
        for k in range(len(held.nodes)):
            held.half[k] = half[held.components[k], held.nodes[k]]
        for c in range(3):
            given = 0.0
            if damped:
                _forces(f[c], external[c], nodes.damping, half[c], u[c])
                power, taken, total = _advance_damped(f[c], nodes.damping, nodes.inverse, h, half[c], u[c])
                forces[DRAGS, c] -= total
                works[DAMPING] += h * taken
                if loaded:
                    forces[LOADS, c], given = _load(external[c], h, half[c], u[c])
            elif loaded:
                power, given, forces[LOADS, c] = _advance(f[c], external[c], nodes.inverse, h, half[c], u[c])
            else:
                power, _, _ = _advance(f[c], None, nodes.inverse, h, half[c], u[c])
            works[INTERNAL] += h * power
            works[EXTERNAL] += h * given

    return balance


@inlined
def displace(c, i, du, nodes, motion, sums):
    """Add to the increment of component c of node i, and to all sums of the balance."""
    h = motion.h
    change = 0.5 * du  # h times that of the velocity
    motion.u[c, i] += du
    motion.half[c, i] += du / h
    sums.works[INTERNAL] += motion.f[c, i] * change
    if nodes.external.shape[1] > 0:
        sums.works[EXTERNAL] += nodes.external[c, i] * change
    if len(nodes.damping) > 0:
        v = motion.half[c, i] - 0.5 * motion.u[c, i] / h
        before = v - change / h
        sums.works[DAMPING] += h * nodes.damping[i] * (v * v - before * before)
        sums.forces[DRAGS, c] -= nodes.damping[i] * (v - before)


@addressed
def apply_supports(s, step):
    """Give prescribed components their increments, by the velocities that :func:`balancing` has kept."""
    held, nodes, motion, sums = s.held, s.nodes, s.motion, s.sums
    h, loaded, damped = motion.h, nodes.external.shape[1] > 0, len(nodes.damping) > 0
    for k in range(len(held.nodes)):
        i, c = held.nodes[k], held.components[k]
        force = -motion.f[c, i]
        if loaded:
            force += nodes.external[c, i]
        if damped:
            force -= nodes.damping[i] * held.half[k]
        free = force * nodes.inverse[i]
        held.load[k] = nodes.stiffness[i] * free
        held.u[k] = held.positions[k] - (motion.x[c, i] + h * held.half[k])
        displace(c, i, held.u[k] - free, nodes, motion, sums)
        motion.half[c, i] = held.half[k] + held.u[k] / h  # exact at rest


@addressed
def react(s, step):
    """Write the reactions of supports, when contact forces are known."""
    held, nodes, motion, sums = s.held, s.nodes, s.motion, s.sums
    for k in range(len(held.nodes)):
        i, c = held.nodes[k], held.components[k]
        reaction = nodes.stiffness[i] * held.u[k] - held.load[k] - motion.contact[i, c]
        held.reaction[i, c] = reaction
        sums.forces[SUPPORTS, c] += reaction


@inlined
def work_of_contact(touched, motion, sums):
    """Add the work of contact forces at some nodes."""
    h, power = motion.h, 0.0
    for i in touched:
        for c in range(3):
            power += motion.contact[i, c] * (motion.half[c, i] - 0.5 / h * motion.u[c, i])
    sums.works[CONTACT] += h * power


@inlined
def rates_of(i, motion, v, a):
    """Write velocity and acceleration of the balance at node i to ``v``, ``a`` (n, 3)."""
    h = motion.h
    for c in range(3):
        v[i, c] = motion.half[c, i] - 0.5 / h * motion.u[c, i]
        a[i, c] = motion.u[c, i] / (h * h)


@inlined
def _scheme_rates(p, moving, held, motion):
    """Return node, component, velocity and acceleration by the scheme of a component that moves."""
    k = moving.at[p]
    i, c = held.nodes[k], held.components[k]
    return i, c, motion.half[c, i] - 0.5 / motion.h * held.u[k], held.u[k] / (motion.h * motion.h)


@addressed
def correct_moving(s, step):
    """Correct the balance of a step for supports that move, and write ``jumps``."""
    moving, held, nodes, motion, sums = s.moving, s.held, s.nodes, s.motion, s.sums
    h, damped = motion.h, len(nodes.damping) > 0
    works, forces, jumps = sums.works, sums.forces, sums.jumps
    clear_rows(jumps)
    for p in range(len(moving.at)):
        i, c, v, a = _scheme_rates(p, moving, held, motion)
        speed, rate = moving.motions[step + 1, 1, moving.columns[p]], moving.motions[step + 1, 2, moving.columns[p]]
        mass = nodes.mass[i]
        change = mass * (rate - a)
        if damped:
            drag = nodes.damping[i] * (speed - v)
            change += drag
            forces[DRAGS, c] -= drag
            works[DAMPING] += h * (drag * v)
        held.reaction[i, c] += change
        forces[SUPPORTS, c] += change
        works[EXTERNAL] += h * (held.reaction[i, c] * v)
        works[INERTIAL] += h * (mass * rate * v)
        jumps[0, c] += mass * (h * (a - rate))
        jumps[1, c] += mass * (speed - (motion.half[c, i] - h * a + 0.5 * h * rate))


@addressed
def correct_moving_ends(s, step):
    """Correct the sums at the end of a step, and the impulses, for supports that move."""
    moving, held, nodes, motion, sums = s.moving, s.held, s.nodes, s.motion, s.sums
    h, x, damped, works, momenta = motion.h, motion.x, len(nodes.damping) > 0, sums.ends, sums.momenta
    for p in range(len(moving.at)):
        i, c, v, a = _scheme_rates(p, moving, held, motion)
        speed, rate = moving.motions[step + 1, 1, moving.columns[p]], moving.motions[step + 1, 2, moving.columns[p]]
        mass, left = nodes.mass[i], (0.5 * h) * (v - (0.5 * h) * a)
        works[EXTERNAL] += held.reaction[i, c] * left
        if damped:
            works[DAMPING] += nodes.damping[i] * (speed - v) * left
        works[INERTIAL] += 0.5 * mass * speed * speed - mass * rate * left - 0.125 * h * h * (mass * a * a)
        works[KINETIC] += 0.5 * mass * (speed * speed - v * v)
        momentum = mass * (speed - v)
        one, other = (c + 1) % 3, (c + 2) % 3
        momenta[0, c] += momentum
        momenta[1, one] += x[other, i] * momentum
        momenta[1, other] -= x[one, i] * momentum
    for c in range(3):
        s.impulses.v[SUPPORTS, c] += sums.jumps[1, c]


@inlined
def put_rates(moving, step, held, v, a):
    """Set velocities and accelerations (n, 3) of the components that move at the end of a step."""
    for p in range(len(moving.at)):
        i, c = held.nodes[moving.at[p]], held.components[moving.at[p]]
        v[i, c] = moving.motions[step + 1, 1, moving.columns[p]]
        a[i, c] = moving.motions[step + 1, 2, moving.columns[p]]


@inlined
def accumulate(nodes, motion, touched, sums):
    """Write the works over the last half of a step, kinetic energy and momenta; ``touched`` have contact forces."""
    h, ends, momenta, x, half, u = motion.h, sums.ends, sums.momenta, motion.x, motion.half, motion.u
    clear_vector(ends)
    for c in range(3):
        work, square, kinetic, momenta[0, c] = _sum_component(half[c], u[c], motion.f[c], nodes.mass, h)
        ends[INTERNAL] += work
        ends[INERTIAL] += 0.125 / (h * h) * square
        ends[KINETIC] += 0.5 * kinetic
        one, other = (c + 1) % 3, (c + 2) % 3
        turn = x[one], half[one], u[one], x[other], half[other], u[other]
        momenta[1, c], momenta[2, one] = _sum_turn(turn, nodes.mass, h)
    for i in touched:
        for c in range(3):
            left = 0.5 * (h * half[c, i] - u[c, i])
            ends[CONTACT] += motion.contact[i, c] * left


@addressed
def accumulate_loads(s, step):
    """Write the works of loads and of dampers over the last half of a step, (h half - u)/2."""
    h, given, taken = s.motion.h, 0.0, 0.0
    for c in range(3):
        external, damping, half, u = s.nodes.external[c], s.nodes.damping, s.motion.half[c], s.motion.u[c]
        for i in range(len(external)):
            given = add_freely(given, external[i] * (0.5 * (h * half[i] - u[i])))
        for i in range(len(damping)):
            taken = add_freely(taken, damping[i] * (half[i] - 0.5 / h * u[i]) * (0.5 * (h * half[i] - u[i])))
    s.sums.ends[EXTERNAL] += given
    s.sums.ends[DAMPING] += taken


@inlined
def _sum_component(half, u, f, mass, h):
    """Return sums of a component: work of internal forces over the last half of the step, m u^2, m v^2, and m v."""
    eta = 0.5 / h
    work = square = kinetic = momentum = 0.0
    for i in range(len(mass)):
        m, v = mass[i], half[i] - eta * u[i]
        work = add_freely(work, f[i] * (h * half[i] - u[i]))
        square = add_freely(square, m * (u[i] * u[i]))
        kinetic = add_freely(kinetic, m * (v * v))
        momentum = add_freely(momentum, m * v)
    return 0.5 * work, square, kinetic, momentum


@inlined
def _sum_turn(components, mass, h):
    """Return sums of two components: angular momentum about the third axis, and mass times the first position."""
    x, half, u, y, rate, w = components
    eta, turned, moment = 0.5 / h, 0.0, 0.0
    for i in range(len(mass)):
        m = mass[i]
        moment = add_freely(moment, m * x[i])
        turned = add_freely(turned, m * (x[i] * (rate[i] - eta * w[i]) - y[i] * (half[i] - eta * u[i])))
    return turned, moment


def power(force: np.ndarray, v: np.ndarray) -> float:
    """Return the sum of force times velocity, or of force times displacement, (n, 3) both, over nodes and
    components."""
    return float(np.einsum("ij,ij->", force, v))


@kernel
def sum_momenta(x, mass, momentum):
    """Return momentum, angular momentum and mass times position (3, 3) of nodes at ``x`` (n, 3) with ``momentum`` (n,
    3) and lumped ``mass`` (n,)."""
    sums = np.zeros((3, 3))
    for i in range(len(x)):
        for c in range(3):
            one, other = (c + 1) % 3, (c + 2) % 3
            sums[0, c] += momentum[i, c]
            sums[1, c] += x[i, one] * momentum[i, other] - x[i, other] * momentum[i, one]
            sums[2, c] += mass[i] * x[i, c]
    return sums
