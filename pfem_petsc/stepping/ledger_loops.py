"""Compiled loops of the energy ledger: sums over owned nodes, balances, and rows of the history."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..columns import BAR_ENERGIES, HEAD, PAIR, WALL
from ..mechanics.compiled import inlined, kernel
from .impulses import WALLS

WORKS = ("external", "contact", "damping", "inertial", "internal")
"""Works that :func:`book_nodes` returns [J], in this order; the first includes supports."""

TOTALS = ("momentum", "angular_momentum", "mass_times_position", "support", "external", "damping")
"""Vectors that :func:`book_nodes` returns, in this order; the last two are sums of forces."""

LANES = 128
"""Nodes with sums of their own; blocks of nodes begin at multiples of it."""

WIDE = 3 * LANES
"""Components of these nodes."""

_KINETIC, _MOMENTUM, _ANGULAR, _MOVED, _SUPPORT, _EXTERNAL, _DAMPING, _CROSSED = (WIDE * k for k in range(8))
_WORK_EXTERNAL, _WORK_CONTACT, _WORK_DAMPING, _WORK_INERTIAL, _WORK_INTERNAL = (WIDE * k for k in range(8, 13))
_WORK_SUPPORT = WIDE * 13
_BY_EXTERNAL = WORKS.index("external")
# workspaces after the sums: mass, mass times velocity, half the displacement
_MASSES, _PULSES, _WAYS = (WIDE * k for k in range(14, 17))


class NodeValues(NamedTuple):
    """Values at owned nodes at an instant, (owned, 3); ``external``, ``support``, ``contact`` may be (0, 3) for zero,
    ``mass`` is (owned,), and ``damping`` (owned,), or (0,) for none."""

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    internal: np.ndarray
    external: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    mass: np.ndarray
    damping: np.ndarray


class Acting(NamedTuple):
    """Whether supports, loads, contact and damping act in a balance."""

    supports: bool
    loads: bool
    contact: bool
    damping: bool


class StepWorks(NamedTuple):
    """Works and dissipations of a step besides those at nodes [J].

    ``stored``: change of the energies of nodes and bars; ``heating``: work of changing temperatures; ``impact``,
    ``friction``: dissipations; ``walls``, ``bodies``, ``weight``, ``lost``: work on the truss of walls that move as
    prescribed and of those with mass, work of the weight of these, and their numerical dissipation; ``jumped``: energy
    that a treatment of impact gave to nodes."""

    stored: float
    heating: float
    impact: float
    friction: float
    walls: float
    bodies: float
    weight: float
    lost: float
    jumped: float


@kernel
def new_lanes():
    """Return the sums of all lanes, zero, and workspace."""
    return np.zeros(_WAYS + WIDE)


@kernel
def _book_part(start, present, momenta, first, second, lanes):
    """Add all nodes to the sums of the lanes; arguments as those of :func:`book_nodes`."""
    factor, p = momenta
    x1, mass, v, support, damping = present.x, present.mass, present.v, present.support, present.damping
    a0, a1, v0, v1, f0, f1 = first.a, second.a, first.v, second.v, first.internal, second.internal
    e0, e1, s0, s1 = first.external, second.external, first.support, second.support
    r0, r1 = first.contact, second.contact
    # Each loop reads few arrays: with more the compiler does not check that they do not overlap. Loops begin at zero,
    # which spares them a check for negative indices.
    masses, ways = lanes[_MASSES : _MASSES + WIDE], lanes[_WAYS : _WAYS + WIDE]
    kinetic = lanes[_KINETIC : _KINETIC + WIDE]
    inertial = lanes[_WORK_INERTIAL : _WORK_INERTIAL + WIDE]
    internal = lanes[_WORK_INTERNAL : _WORK_INTERNAL + WIDE]
    external = lanes[_WORK_EXTERNAL : _WORK_EXTERNAL + WIDE]
    for at in range(0, len(start), LANES):
        last = min(at + LANES, len(start))
        wide = 3 * (last - at)
        z0, z1 = start[at:last].reshape(-1), x1[at:last].reshape(-1)
        speeds, pulses = v[at:last].reshape(-1), p[at:last].reshape(-1)
        _add_totals(mass[at:last], factor[at:last], z1, pulses, lanes)
        spread(factor[at:last], masses)
        for j in range(wide):
            kinetic[j] += masses[j] * pulses[j] * speeds[j]
        one, other = a0[at:last].reshape(-1), a1[at:last].reshape(-1)
        for j in range(wide):
            way = 0.5 * (z1[j] - z0[j])
            ways[j] = way
            inertial[j] += masses[j] * (way * (one[j] + other[j]))
        one, other = f0[at:last].reshape(-1), f1[at:last].reshape(-1)
        for j in range(wide):
            internal[j] += ways[j] * (one[j] + other[j])
        if len(e0) > 0:
            one, other = e0[at:last].reshape(-1), e1[at:last].reshape(-1)
            loads = lanes[_EXTERNAL : _EXTERNAL + WIDE]
            for j in range(wide):
                external[j] += ways[j] * (one[j] + other[j])
                loads[j] += other[j]
        if len(s0) > 0:
            one, other, held = s0[at:last].reshape(-1), s1[at:last].reshape(-1), support[at:last].reshape(-1)
            reactions, work = lanes[_SUPPORT : _SUPPORT + WIDE], lanes[_WORK_SUPPORT : _WORK_SUPPORT + WIDE]
            for j in range(wide):
                work[j] += ways[j] * (one[j] + other[j])
                reactions[j] += held[j]
        if len(r0) > 0:
            one, other = r0[at:last].reshape(-1), r1[at:last].reshape(-1)
            contact = lanes[_WORK_CONTACT : _WORK_CONTACT + WIDE]
            for j in range(wide):
                contact[j] += ways[j] * (one[j] + other[j])
        if len(damping) > 0:
            spread(damping[at:last], masses)
            one, other = v0[at:last].reshape(-1), v1[at:last].reshape(-1)
            work, drags = lanes[_WORK_DAMPING : _WORK_DAMPING + WIDE], lanes[_DAMPING : _DAMPING + WIDE]
            for j in range(wide):
                work[j] += masses[j] * (ways[j] * (one[j] + other[j]))
                drags[j] -= masses[j] * other[j]


@inlined
def spread(values, masses):
    """Write the value of each node three times."""
    for i in range(len(values)):
        masses[3 * i] = values[i]
        masses[3 * i + 1] = values[i]
        masses[3 * i + 2] = values[i]


@kernel
def _add_totals(mass, factor, x, p, lanes):
    """Add momentum, angular momentum and mass times position of some nodes to the sums of the lanes."""
    masses, products = lanes[_MASSES : _MASSES + WIDE], lanes[_PULSES : _PULSES + WIDE]
    moved, momentum = lanes[_MOVED : _MOVED + WIDE], lanes[_MOMENTUM : _MOMENTUM + WIDE]
    angular, crossed = lanes[_ANGULAR : _ANGULAR + WIDE], lanes[_CROSSED : _CROSSED + WIDE]
    spread(mass, masses)
    for j in range(len(x)):
        moved[j] += masses[j] * x[j]
    spread(factor, masses)
    for j in range(len(x)):
        products[j] = masses[j] * p[j]
        momentum[j] += products[j]
    # x p_y - y p_x and y p_z - z p_y at the places of x and y, x p_z - z p_x at that of x; others are not used
    for j in range(len(x) - 1):
        angular[j] += x[j] * products[j + 1] - x[j + 1] * products[j]
    for j in range(len(x) - 2):
        crossed[j] += x[j] * products[j + 2] - x[j + 2] * products[j]


@kernel
def _sum_totals(lanes, wide, count, totals):
    """Write the first ``count`` vectors of ``totals`` from the sums of the lanes."""
    for k in range(count):
        totals[k] = sum_lane(lanes[_MOMENTUM + WIDE * k :], wide)
    across = sum_lane(lanes[_CROSSED:], wide)[0]
    totals[1, 0], totals[1, 1], totals[1, 2] = totals[1, 1], -across, totals[1, 0]


@kernel
def book_totals(x, mass, v, lanes, totals):
    """Write momentum, angular momentum and mass times position of lumped masses into the first rows of ``totals``;
    ``lanes`` is workspace."""
    wide = min(3 * len(x), WIDE)
    for row in (_MOMENTUM, _ANGULAR, _MOVED, _CROSSED):
        sums = lanes[row : row + WIDE]
        for j in range(wide):  # much faster than an assignment to a slice
            sums[j] = 0.0
    for first in range(0, len(x), LANES):
        last = min(first + LANES, len(x))
        masses = mass[first:last]
        _add_totals(masses, masses, x[first:last].reshape(-1), v[first:last].reshape(-1), lanes)
    _sum_totals(lanes, wide, 3, totals)


@inlined
def sum_lane(lanes, wide):
    """Return the sums of each component of some lanes, of four nodes at a time, so that additions do not wait for each
    other; beyond ``wide`` lanes are zero."""
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
    for j in range(0, wide, 12):
        x0 += lanes[j]
        y0 += lanes[j + 1]
        z0 += lanes[j + 2]
        x1 += lanes[j + 3]
        y1 += lanes[j + 4]
        z1 += lanes[j + 5]
        x2 += lanes[j + 6]
        y2 += lanes[j + 7]
        z2 += lanes[j + 8]
        x3 += lanes[j + 9]
        y3 += lanes[j + 10]
        z3 += lanes[j + 11]
    return (x0 + x1) + (x2 + x3), (y0 + y1) + (y2 + y3), (z0 + z1) + (z2 + z3)


@kernel
def book_nodes(start, present, momenta, first, second, totals, works):
    """Return the kinetic energy [J] at the end of a step; sum over nodes there, and works over its displacements by the
    mean of two sets of forces.

    Parameters
    ----------
    start : (owned, 3) positions at the start
    present : NodeValues at the end, whose ``damping`` multiplies the velocities of the sets of forces
    momenta : ``factor`` (owned,) and ``p`` (owned, 3), whose product is the momentum: m v, or M v with factor one
    first, second : NodeValues at start and end of the works' rule; external, support and contact forces are (0, 3) in
        both, or in none
    totals : (6, 3) output, see :data:`TOTALS`; external and damping force are those at the end of the works' rule
    works : (5,) output [J], see :data:`WORKS`
    """
    lanes = new_lanes()
    _book_part(start, present, momenta, first, second, lanes)
    wide = min(3 * len(start), WIDE)
    _sum_totals(lanes, wide, len(totals), totals)
    for k in range(len(works)):
        x, y, z = sum_lane(lanes[_WORK_EXTERNAL + WIDE * k :], wide)
        works[k] = x + y + z
    x, y, z = sum_lane(lanes[_WORK_SUPPORT:], wide)
    works[_BY_EXTERNAL] += x + y + z
    x, y, z = sum_lane(lanes, wide)  # the first are those of the kinetic energy
    return 0.5 * (x + y + z)


_BARS = tuple(HEAD.first(name) for name in BAR_ENERGIES)
_EXTERNAL_WORK, _CONTACT_WORK = HEAD.first("external_work"), HEAD.first("contact_work")
_DAMPING_DISSIPATION, _THERMAL = HEAD.first("damping_dissipation"), HEAD.first("thermal_work")
_FRICTION, _IMPACT = HEAD.first("friction_dissipation"), HEAD.first("impact_dissipation")
_NUMERICAL, _TOTALS = HEAD.first("numerical_dissipation"), HEAD.first("momentum")
_WALL = WALL.width
_FORCE, _MOMENT, _IMPULSE = WALL.first("force"), WALL.first("moment"), WALL.first("impulse")
_TOUCHED, _RELEASES = WALL.first("contacts"), WALL.first("releases")
_PAIR, _PUSH = PAIR.width, PAIR.first("force")
_LINK_IMPULSE, _JUMP = PAIR.first("impulse"), PAIR.first("jump_impulse")
_BY_LOADS, _BY_CONTACT, _BY_DAMPING, _BY_INERTIA, _BY_BARS = range(len(WORKS))


@kernel
def add_works(sums, works, step) -> None:
    """Add the works and dissipations of a step to the sums of a row [J].

    Parameters
    ----------
    sums : (HEAD.width,) in the layout of :data:`~pfem_petsc.columns.HEAD`
    works : (5,) see :data:`WORKS`
    step : StepWorks
    """
    sums[_EXTERNAL_WORK] += works[_BY_LOADS] + step.weight
    sums[_CONTACT_WORK] += step.walls
    sums[_DAMPING_DISSIPATION] += works[_BY_DAMPING]
    sums[_THERMAL] += step.heating
    sums[_FRICTION] += step.friction
    sums[_IMPACT] += step.impact
    # the work of contact on nodes in excess of the work of walls and the losses by friction and impact
    left = works[_BY_CONTACT] + step.jumped - step.walls - step.bodies + step.friction
    sums[_NUMERICAL] += (
        works[_BY_INERTIA] + works[_BY_BARS] + step.heating - step.stored - left - step.impact + step.lost
    )


@kernel
def fill_works(sums, powers, ends, held) -> None:
    """Write the works and dissipations of a leapfrog scheme up to the end of a step [J].

    Parameters
    ----------
    sums : (HEAD.width,) of a row; those of impact are complete
    powers : (5,) of the balances before, see :class:`~pfem_petsc.stepping.ledger.LeapfrogLedger`
    ends : (5,) of the last balance, see :func:`~pfem_petsc.stepping.ledger_loops.book_row`
    held : energies of the bars
    """
    sums[_EXTERNAL_WORK] = powers[_BY_LOADS] + ends[_BY_LOADS]
    sums[_DAMPING_DISSIPATION] = powers[_BY_DAMPING] + ends[_BY_DAMPING]
    bars, contact = powers[_BY_BARS] + ends[_BY_BARS], powers[_BY_CONTACT] + ends[_BY_CONTACT]
    sums[_NUMERICAL] = (bars - held) + powers[_BY_INERTIA] - ends[_BY_INERTIA] - contact - sums[_IMPACT]


@kernel
def add_totals(sums, totals) -> None:
    """Write the present totals (6, 3), see ``TOTALS`` of ``book_loops``."""
    for k in range(4):
        for c in range(3):
            sums[_TOTALS + 3 * k + c] = totals[k, c]


@kernel
def fill_bars(row, energies) -> None:
    """Write the energies of the bars, in the order of ``BAR_ENERGIES``."""
    for k in range(len(energies)):
        row[_BARS[k]] = energies[k]


@kernel
def fill_walls(row, at, force, moment, v, contacts, releases) -> int:
    """Write sums of walls from index ``at`` of a row; return the next index. ``v``: of the particles of impulses."""
    for k in range(len(force)):
        row[at + _FORCE : at + _FORCE + 3] = force[k]
        row[at + _MOMENT : at + _MOMENT + 3] = moment[k]
        row[at + _IMPULSE : at + _IMPULSE + 3] = v[WALLS + k]
        row[at + _TOUCHED], row[at + _RELEASES] = contacts[k], releases[k]
        at += _WALL
    return at


@kernel
def fill_links(row, at, force, v, first) -> int:
    """Write sums of the tables of links from index ``at`` of a row; return the next index. ``v``: of the particles of
    impulses, of which that of the first table is ``first``."""
    jumps = len(v) - len(force)
    for k in range(len(force)):
        row[at + _PUSH : at + _PUSH + 3] = force[k]
        row[at + _LINK_IMPULSE : at + _LINK_IMPULSE + 3] = v[first + k]
        row[at + _JUMP : at + _JUMP + 3] = v[jumps + k]
        at += _PAIR
    return at


@kernel
def fill_probes(row, at, probes, values) -> None:
    """Write positions, velocities, accelerations and reactions of this rank's probed nodes, from index ``at`` of a row.

    ``probes``: see :class:`~pfem_petsc.stepping.batch_loop.ProbeArrays`; ``values``: NodeValues.
    """
    supported = len(values.support) > 0
    for j in range(len(probes.nodes)):
        i = probes.nodes[j]
        first, size = at + probes.places[j], 3 * probes.counts[j]
        for c in range(3):
            row[first + c] = values.x[i, c]
            row[first + size + c] = values.v[i, c]
            row[first + 2 * size + c] = values.a[i, c]
            row[first + 3 * size + c] = values.contact[i, c] + (values.support[i, c] if supported else 0.0)


# rows of lanes: one for each work, in the order of WORKS, with that of inertia unused; then sums of forces
EXTERNAL, CONTACT, DAMPING, INERTIAL, INTERNAL = range(len(WORKS))
REACTIONS, _PUSHES, _DRAGS = (len(WORKS) + k for k in range(3))
_ROWS = len(WORKS) + 3


@kernel
def new_sums():
    """Return the lanes of all sums, zero."""
    return np.zeros((_ROWS, WIDE))


@kernel
def clear_sums(sums, n):
    """Set the lanes of a sum over ``n`` nodes to zero."""
    for j in range(min(3 * n, WIDE)):  # much faster than an assignment to a slice
        sums[j] = 0.0


@kernel
def clear_forces(lanes, n, acting):
    """Set the sums of a balance to zero, as far as there are supports, loads and damping; not those of contact."""
    clear_sums(lanes[INTERNAL], n)
    if acting.supports:
        clear_sums(lanes[REACTIONS], n)
    if acting.loads:
        clear_sums(lanes[EXTERNAL], n)
        clear_sums(lanes[_PUSHES], n)
    if acting.damping:
        clear_sums(lanes[DAMPING], n)
        clear_sums(lanes[_DRAGS], n)


@kernel
def start_of_step(x, h, v, a, before):
    """Compute the positions ``before`` the last step; arrays (3 n,)."""
    for j in range(len(x)):
        before[j] = x[j] - h * (v[j] - 0.5 * h * a[j])


@kernel
def add_powers(force, v, sums):
    """Add force times velocity (3 n,) of consecutive nodes, from a multiple of :data:`LANES` on, to ``sums``."""
    for first in range(0, len(v), WIDE):
        last = min(first + WIDE, len(v))
        one, other = force[first:last], v[first:last]
        for j in range(len(one)):
            sums[j] += one[j] * other[j]


@kernel
def add_forces(force, sums):
    """Add forces (3 n,) of consecutive nodes, from a multiple of :data:`LANES` on, to ``sums``."""
    for first in range(0, len(force), WIDE):
        last = min(first + WIDE, len(force))
        one = force[first:last]
        for j in range(len(one)):
            sums[j] += one[j]


@kernel
def add_sparse_powers(nodes, force, v, sums):
    """Add force times velocity (n, 3) at some nodes, sorted, like :func:`add_powers` those at all nodes."""
    for i in nodes:
        at = 3 * (i % LANES)
        for c in range(3):
            sums[at + c] += force[i, c] * v[i, c]


@kernel
def add_sparse_forces(begin, end, nodes, components, force, sums):
    """Add ``force`` (n, 3) at the components [begin, end), sorted by node, like :func:`add_forces` all forces."""
    for k in range(begin, end):
        i, c = nodes[k], components[k]
        sums[3 * (i % LANES) + c] += force[i, c]


@kernel
def add_drags(damping, v, drag, lanes):
    """Add damping forces and their powers; ``damping`` (n,), ``v`` (3 n,), of consecutive nodes; ``drag``, workspace of
    this size or larger."""
    spread(damping, drag)
    for j in range(len(v)):
        drag[j] *= v[j]
    add_powers(drag, v, lanes[DAMPING])
    add_forces(drag[: len(v)], lanes[_DRAGS])


@kernel
def add_loads(external, v, lanes):
    """Add external forces and their powers; arrays (3 n,) of consecutive nodes."""
    add_powers(external, v, lanes[EXTERNAL])
    add_forces(external, lanes[_PUSHES])


@kernel
def sum_balance(lanes, n, h, acting, totals, powers):
    """Add ``h`` times the powers of a balance to ``powers`` (5,) [J], and write the sums of forces into ``totals``;
    those of supports, loads, contact and damping as far as there are any."""
    wide = min(3 * n, WIDE)
    for k in range(3, 6):
        for c in range(3):
            totals[k, c] = 0.0
    _sum_power(lanes, INTERNAL, wide, h, powers)
    if acting.supports:
        totals[3] = sum_lane(lanes[REACTIONS], wide)
    if acting.loads:
        _sum_power(lanes, EXTERNAL, wide, h, powers)
        totals[4] = sum_lane(lanes[_PUSHES], wide)
    if acting.contact:
        _sum_power(lanes, CONTACT, wide, h, powers)
    if acting.damping:
        _sum_power(lanes, DAMPING, wide, h, powers)
        x, y, z = sum_lane(lanes[_DRAGS], wide)
        totals[5] = -x, -y, -z


@kernel
def _sum_power(lanes, row, wide, h, powers):
    x, y, z = sum_lane(lanes[row], wide)
    powers[row] += h * (x + y + z)


@kernel
def book_balance(values, h, totals, powers):
    """Add the works of a balance, ``h`` times force times velocity, to ``powers`` (5,) [J], in the order of ``WORKS``;
    write the sums of support, external and damping forces into ``totals`` (6, 3) [N]. ``values``: NodeValues."""
    v, external, support, contact, damping = (
        values.v,
        values.external,
        values.support,
        values.contact,
        values.damping,
    )
    n = len(v)
    acting = Acting(len(support) > 0, len(external) > 0, len(contact) > 0, len(damping) > 0)
    lanes = new_sums()
    drag = np.empty(WIDE)
    for first in range(0, n, LANES):  # velocities are read once from memory
        last = min(first + LANES, n)
        speeds = v[first:last].reshape(-1)
        add_powers(values.internal[first:last].reshape(-1), speeds, lanes[INTERNAL])
        if acting.supports:
            add_forces(support[first:last].reshape(-1), lanes[REACTIONS])
        if acting.loads:
            add_loads(external[first:last].reshape(-1), speeds, lanes)
        if acting.contact:
            add_powers(contact[first:last].reshape(-1), speeds, lanes[CONTACT])
        if acting.damping:
            add_drags(damping[first:last], speeds, drag, lanes)
    sum_balance(lanes, n, h, acting, totals, powers)


class RowRoom(NamedTuple):
    """Workspace of :func:`book_row`: lanes of sums, and those of totals."""

    sums: np.ndarray
    totals: np.ndarray


@kernel
def new_row_room():
    """Return workspace for rows."""
    return RowRoom(new_sums(), new_lanes())


@kernel
def book_row(values, h, room, totals, ends):
    """Return the kinetic energy [J]; write momentum, angular momentum and mass times position into ``totals`` (6, 3),
    and into ``ends`` (5,) [J], in the order of ``WORKS``, half the works over the last step of the forces at its end.

    The step was h v - h^2 a/2. At the place of inertia is h^2/8 times the sum of m a . a. ``values``: NodeValues;
    ``room``: RowRoom.
    """
    v, a, mass, external, contact, damping = (
        values.v,
        values.a,
        values.mass,
        values.external,
        values.contact,
        values.damping,
    )
    n, lanes = len(v), room.sums
    wide = min(3 * n, WIDE)
    half, eighth = 0.5 * h, 0.125 * h * h
    loaded, pressed, damped = len(external) > 0, len(contact) > 0, len(damping) > 0
    masses, ways, drags = np.empty(WIDE), np.empty(WIDE), np.empty(WIDE)
    for k in range(len(lanes)):
        clear_sums(lanes[k], n)
    kinetic, inertial = lanes[REACTIONS], lanes[INERTIAL]
    for first in range(0, n, LANES):
        last = min(first + LANES, n)
        speeds, pulls = v[first:last].reshape(-1), a[first:last].reshape(-1)
        spread(mass[first:last], masses)
        for j in range(len(speeds)):
            kinetic[j] += masses[j] * speeds[j] * speeds[j]
            inertial[j] += masses[j] * pulls[j] * pulls[j]
        for j in range(len(speeds)):
            ways[j] = half * (speeds[j] - half * pulls[j])
        here = ways[: len(speeds)]
        add_powers(values.internal[first:last].reshape(-1), here, lanes[INTERNAL])
        if loaded:
            add_powers(external[first:last].reshape(-1), here, lanes[EXTERNAL])
        if pressed:
            add_powers(contact[first:last].reshape(-1), here, lanes[CONTACT])
        if damped:
            spread(damping[first:last], drags)
            for j in range(len(speeds)):
                drags[j] *= speeds[j]
            add_powers(drags, here, lanes[DAMPING])
    for k in range(len(ends)):
        ends[k] = 0.0
        _sum_power(lanes, k, wide, eighth if k == INERTIAL else 1.0, ends)
    one, two, three = sum_lane(kinetic, wide)
    book_totals(values.x, mass, v, room.totals, totals)
    return 0.5 * (one + two + three)
