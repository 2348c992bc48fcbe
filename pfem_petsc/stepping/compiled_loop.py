"""Steps of central differences in one compiled call, as many as nothing outside needs: the phases in their order, the
messages between ranks, and this rank's shares of the rows of the history."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..columns import BAR_ENERGIES, HEAD, PROBED
from ..contact.fixed_rows import FixedRows, pressed_nodes
from ..contact.node_walls import compare_contacts
from ..mechanics.compiled import kernel
from ..mechanics.elements import first_inverted
from ..mechanics.internal_forces import BarArrays, internal_forces
from ..mechanics.layout import clear, join_components, split_components
from ..mechanics.loads import LoadSchedule, set_forces
from ..mechanics.records import record
from ..mesh.exchange import Messages
from .contact_phase import (
    ContactNodes,
    WallArrays,
    place_walls,
    project_on_rows,
    project_on_walls,
    stop_at_rows,
    stop_at_walls,
    sum_rows,
    work_of_walls,
)
from .impact import join_nodes
from .impulses import SUPPORT, WALLS, ContactSums, record_forces
from .phases import (
    CONTACT,
    DAMPING,
    EXTERNAL,
    INERTIAL,
    INTERNAL,
    KINETIC,
    SUPPORTS,
    GroundSprings,
    Motion,
    MovingSupports,
    Nodes,
    Prescribed,
    StepSums,
    accumulate,
    add_springs,
    apply_supports,
    balance,
    clear_vector,
    correct_moving,
    correct_moving_ends,
    displace,
    move,
    numerical_dissipation,
    place_supports,
    put_rates,
    rates_of,
    react,
    restore_increments,
    work_of_contact,
)

SOLVE, CLOSE = range(2)
"""What a call of Python does: solve rows, or find the energy that they lose."""

FAILED, LOST = -1, -2
"""Results of calls: a failure of the simulation, any other error."""


record(Messages)


@record
class StepBars(NamedTuple):
    """Bars in steps: what their loops read; loops of their laws without and with energies, see
    :func:`~pfem_petsc.mechanics.chunk_laws.law_loops`; their ``ends`` and lengths that are ``watched``, see ``Bars``;
    and whether bars of the case can break, the same on all ranks."""

    arrays: BarArrays
    brief: Any
    full: Any
    ends: np.ndarray
    watched: np.ndarray
    can_break: bool


@record
class CalledRows(NamedTuple):
    """Rows that Python solves (owned nodes n).

    Attributes
    ----------
    any : whether there are any
    predictor, u : (n, 3) positions to which nodes move without forces, and increments; (0, 3) without calls
    held, changing : (n,) nodes on which rows press, ascending; nodes of rows whose force begins or ends
    counts : (2,) their numbers
    loss : (1,) energy that closing rows lose [J]
    """

    any: bool
    predictor: np.ndarray
    u: np.ndarray
    held: np.ndarray
    changing: np.ndarray
    counts: np.ndarray
    loss: np.ndarray


@record
class StateArrays(NamedTuple):
    """Vectors of nodes outside the loop: positions, those before the last step, and internal forces (local, 3);
    velocities at half steps, increments, velocities and accelerations (n, 3)."""

    x: np.ndarray
    before: np.ndarray
    f: np.ndarray
    half: np.ndarray
    u: np.ndarray
    v: np.ndarray
    a: np.ndarray


@record
class ImpulseArrays(NamedTuple):
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


@record
class Calls(NamedTuple):
    """Functions that the loop calls: of MPI, and one of Python, of a step and :data:`SOLVE` or :data:`CLOSE`."""

    start_all: Any
    wait_all: Any
    reduce_all: Any
    python: Any


@record
class StepArrays(NamedTuple):
    """All that compiled steps read and write, of which the latter parts are: the sums of the ledger, of which the
    dissipations by impact and friction and the work of walls are added to; works (5,) of all balances; particles of
    impulses; the nodes of probes; forces of walls (w, 3) at the start [N]; and this rank's shares (m, width) of the
    rows of the steps that are due, and at last of the last step if it is not, see
    :class:`~pfem_petsc.columns.Share`."""

    nodes: Nodes
    motion: Motion
    held: Prescribed
    moving: MovingSupports
    springs: GroundSprings
    bars: StepBars
    loads: LoadSchedule
    walls: WallArrays
    rows: FixedRows
    called: CalledRows
    sums: StepSums
    pressed: ContactNodes
    outcome: np.ndarray
    messages: Messages
    calls: Calls
    state: StateArrays
    ledger: np.ndarray
    works: np.ndarray
    impulses: ImpulseArrays
    probes: np.ndarray
    push: np.ndarray
    shares: np.ndarray


class Contacts(NamedTuple):
    """Contacts from step to step: nodes (m,) that touch walls; that have touched walls and not left them; changes
    since the last row; and the energy that friction dissipates in the next step [J]."""

    touched: np.ndarray
    met: np.ndarray
    changes: int
    friction: float


DONE, PASSED, RECORDED, LOST_BY_MPI, CHANGED, COLLAPSED, TURNED, UNSOLVED, NEAR, PRESSING = range(10)
"""Numbers of the outcome of some steps: of steps made; of those that other ranks make too, of which this one only sends
messages after a failure; of shares of rows; the error code of MPI. In the last step: the number of bars that changed
their state of rupture; the first bar that collapsed, and that went through zero length, or -1; whether a call for rows
failed; the number of nodes near walls, in ContactNodes; and of nodes with contact forces."""


_PUSHED, _RUBBED, _IMPACT = map(HEAD.first, ("contact_work", "friction_dissipation", "impact_dissipation"))
_EXTERNAL_WORK, _DAMPED, _NUMERICAL, _KINETIC = map(
    HEAD.first, ("external_work", "damping_dissipation", "numerical_dissipation", "kinetic_energy")
)
_MOMENTA, _SUPPORT, _PRESSING = map(
    HEAD.first,
    (
        "momentum",  # followed by angular momentum and centre of mass
        "support_force",
        "active_contacts",
    ),
)
_BARS, _PROBED = HEAD.indices(BAR_ENERGIES), len(PROBED)
_ENERGIES, _SPRINGS = len(BAR_ENERGIES), BAR_ENERGIES.index("spring_energy")


@kernel
def send_positions(messages, x, calls):
    """Send positions (3, stride) of owned nodes and wait for those of ghosts, in ``messages.arriving``; return MPI's
    error code."""
    for k in range(len(messages.rows)):
        for c in range(3):
            messages.leaving[k, c] = x[c, messages.rows[k]]
    lost = calls.start_all(np.int32(messages.count), messages.requests.ctypes)
    if lost == 0:
        lost = calls.wait_all(np.int32(messages.count), messages.requests.ctypes, messages.statuses.ctypes)
    return lost


@kernel
def take_positions(messages, n, x, before):
    """Update the ghosts, which follow ``n`` owned nodes, in ``x`` (3, stride), with their previous positions in
    ``before`` (local, 3)."""
    for k in range(len(messages.arriving)):
        for c in range(3):
            before[n + k, c] = x[c, n + k]
            x[c, n + k] = messages.arriving[k, c]


@kernel
def any_rank(messages, here, calls):
    """Return whether a condition holds on any rank, and MPI's error code. Collective."""
    mine, every, handles = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32), messages.handles
    mine[0] = 1 if here else 0
    lost = calls.reduce_all(mine.ctypes, every.ctypes, np.int32(1), handles[0], handles[1], handles[2])
    return every[0] > 0, lost


@kernel
def take_state(state, motion):
    """Read positions and velocities at half steps by components."""
    split_components(state.x, motion.x)
    split_components(state.half, motion.half)


@kernel
def give_state(state, motion):
    """Write the state at the end of a step, by the scheme alone."""
    n, h = len(state.half), motion.h
    join_components(motion.x, state.x)
    join_components(motion.f, state.f)
    join_components(motion.half, state.half)
    join_components(motion.u, state.u)
    for i in range(n):
        rates_of(i, motion, state.v, state.a)
        for c in range(3):
            state.before[i, c] = state.x[i, c] - (h * state.half[i, c] - state.u[i, c])


@kernel
def begin_step(s, step):
    """Set supports, walls and loads of a step."""
    place_supports(s.moving, step, s.held.positions)
    if len(s.walls.motions) > 0:
        place_walls(step, s.walls)
    if len(s.loads.gravity) > 0:
        set_forces(step, s.loads, s.nodes.mass, s.nodes.external.T)


@kernel
def evaluate_forces(s, energies):
    """Compute internal forces, and the energies unless this array is empty; see
    :func:`~pfem_petsc.mechanics.internal_forces.internal_forces`."""
    bars, springs, motion = s.bars, s.springs, s.motion
    clear(motion.f)
    laws = bars.full if len(energies) > 0 else bars.brief
    clear_vector(energies)
    found = internal_forces(motion.x, motion.f, bars.arrays, laws, motion.h, True, energies)
    if len(springs.nodes) > 0:
        add_springs(springs, motion.x, motion.f, s.sums.springs)
    return found


@kernel
def solve_called(s, step):
    """Have Python solve the rows of a step; return what it returns."""
    called, motion, n = s.called, s.motion, len(s.called.u)
    h, x, half, u = motion.h, motion.x, motion.half, motion.u
    join_components(x, s.state.x)
    for i in range(n):
        for c in range(3):
            called.u[i, c] = u[c, i]
            called.predictor[i, c] = x[c, i] + (h * half[c, i] - u[c, i])
    result = s.calls.python(step, SOLVE)
    for i in range(n):
        for c in range(3):
            if called.u[i, c] != u[c, i]:
                displace(c, i, called.u[i, c] - u[c, i], s.nodes, motion, s.sums)
    return result


@kernel
def lose_energy(s, step, on_walls, altered):
    """Return the dissipation of contacts that close [J], the nodes that are on walls, and what a call returned."""
    moved, state, impact, result = (s.moving, step, s.held), (s.state.v, s.state.a), 0.0, 0
    met = on_walls[0]
    if len(on_walls[0]) > 0 or len(on_walls[1]) > 0:
        impact, met = stop_at_walls(s.nodes, s.motion, s.walls, moved, state, on_walls)
    if altered > 0:
        impact += stop_at_rows(s.nodes, s.motion, s.rows, altered, moved, state, s.walls.touched.slack)
    if s.called.any and s.called.counts[1] > 0:
        for i in s.called.changing[: s.called.counts[1]]:
            rates_of(i, s.motion, s.state.v, s.state.a)
        put_rates(s.moving, step, s.held, s.state.v, s.state.a)
        result = s.calls.python(step, CLOSE)
        impact += s.called.loss[0]
    return impact, met, result


@kernel
def push_particles(forces, walls, links, h, impulses, u):
    """Advance the particles of the impulses by a step; ``forces`` (3, 3), of ``walls`` (walls, 3) and ``links``
    (tables, 3) [N]; their increments are written to ``u`` (rows, 3)."""
    first = WALLS + len(walls)
    for k in range(len(u)):
        for c in range(3):
            if k < WALLS:
                load = forces[k, c]
            elif k < first:
                load = walls[k - WALLS, c]
            else:  # the last rows are those of jumps, which need Python
                load = links[k - first, c] if k < first + len(links) else 0.0
            u[k, c] = h * h * load
            impulses.half[k, c] += h * load


@kernel
def record_row(s, step, counts, particles, energies, row):
    """Write this rank's share of the row of a step; ``counts``: active contacts, and contacts that have changed;
    ``particles`` (rows, 3): increments of the impulses."""
    h, ledger, impulses, works, sums = s.motion.h, s.ledger, s.impulses, s.works, s.sums
    ends = sums.ends
    for k in range(len(particles)):
        for c in range(3):
            impulses.v[k, c] = impulses.half[k, c] - 0.5 / h * particles[k, c]
            impulses.a[k, c] = particles[k, c] / (h * h)
    values = row[len(row) - 3 * _PROBED * len(s.probes) :].reshape(len(s.probes), _PROBED, 3)
    _record_probes(s, values)
    if len(s.moving.at) > 0:
        correct_moving_ends(s.moving, step, s.held, s.nodes, s.motion, sums, values)
        for c in range(3):
            impulses.v[SUPPORT, c] += sums.jumps[1, c]
    for k in range(len(ledger)):
        row[k] = ledger[k]
    stored = 0.0
    for k in range(_ENERGIES):
        row[_BARS[k]] = energies[k]
        stored += energies[k]
    row[_KINETIC] = ends[KINETIC]
    row[_EXTERNAL_WORK] = works[EXTERNAL] + ends[EXTERNAL]
    row[_DAMPED] = works[DAMPING] + ends[DAMPING]
    inertial, internal = works[INERTIAL] - ends[INERTIAL], works[INTERNAL] + ends[INTERNAL]
    excess = works[CONTACT] + ends[CONTACT] - ledger[_PUSHED]
    row[_NUMERICAL] = numerical_dissipation(inertial, internal, stored, excess, ledger[_RUBBED] + ledger[_IMPACT])
    for c in range(3):
        row[_SUPPORT + c] = sums.forces[SUPPORTS, c]
        for k in range(3):
            row[_MOMENTA + 3 * k + c] = sums.momenta[k, c]
    row[_PRESSING] = counts[0]
    pressed = s.pressed
    contact = ContactSums(pressed.force, pressed.moment, pressed.contacts, s.walls.releases, s.rows.totals)
    record_forces(impulses.v, contact, counts[1], row)


@kernel
def _record_probes(s, values):
    """Write motion and forces of supports and contact at the probes, (p, 4, 3)."""
    h, motion = s.motion.h, s.motion
    for k in range(len(s.probes)):
        i = s.probes[k]
        for c in range(3):
            values[k, 0, c] = motion.x[c, i]
            values[k, 1, c] = motion.half[c, i] - 0.5 / h * motion.u[c, i]
            values[k, 2, c] = motion.u[c, i] / (h * h)
            values[k, 3, c] = s.held.reaction[i, c] + motion.contact[i, c]


@kernel
def run_compiled(s, contacts, due, flags):
    """Make some steps, with bars of any law.

    Its arguments are StepArrays; Contacts as a tuple; ``due`` (count,) bool, the steps with a row; and ``flags``
    (count, walls) bool, which receives the walls that are touched in each step. The state is that after the last step.
    Fewer steps are made where bars of any rank change their state of rupture, and where something fails, except on
    several ranks that need not agree: these make all steps then, as others wait for their messages. It returns Contacts
    as a tuple, and writes the outcome.
    """
    touched, met, changes, friction = contacts
    outcome = s.outcome
    nodes, motion, held, walls, rows, messages = s.nodes, s.motion, s.held, s.walls, s.rows, s.messages
    count, n, n_walls = len(due), len(nodes.mass), len(walls.pressed.way)
    several, linked, calling = messages.several, len(rows.force) > 0, s.called.any
    agree = several and (s.bars.can_break or calling)  # ranks that make the same steps
    keeps = n_walls > 0 or linked or calling or len(nodes.damping) > 0 or nodes.external.shape[1] > 0
    sums, pressed, particles = s.sums, s.pressed, np.empty(s.impulses.v.shape)
    pressed.failure[0] = -1
    energies, no_energies = np.zeros(_ENERGIES), np.empty(0)
    # nodes with contact forces of walls, of rows, and of both
    near, others = touched, s.called.held[: s.called.counts[0]]
    if linked:
        others = pressed_nodes(rows, np.count_nonzero(rows.force > 0.0))
    pressing = join_nodes(near, others, walls.present)
    failed, turned, changed, lost, unsolved = np.int64(-1), np.int64(-1), 0, 0, np.int64(0)
    done, passed, recorded, stops, shortened = 0, 0, 0, False, False
    take_state(s.state, motion)
    for step in range(count):
        if failed >= 0 or turned >= 0 or pressed.failure[0] >= 0:
            # the other ranks still need messages, until all know of the failure
            lost = send_positions(messages, motion.x, s.calls)
            passed += 1
            if lost != 0:
                break
            continue
        last_one = step == count - 1
        ending = due[step] or last_one
        for i in pressing:
            for c in range(3):
                motion.contact[i, c] = 0.0
        begin_step(s, step)
        s.ledger[_RUBBED] += friction  # on the way that the balance before has determined
        friction = 0.0
        move(motion.x, motion.h, motion.half)
        if several:
            lost = send_positions(messages, motion.x, s.calls)
            if lost != 0:
                break
            take_positions(messages, n, motion.x, s.state.before)
        wanted = energies if ending or s.bars.can_break else no_energies  # a bar that breaks ends the steps
        failed, shortened, changed = evaluate_forces(s, wanted)
        balance(nodes, motion, held, keeps or ending, sums)
        apply_supports(held, nodes, motion, sums)
        some, altered, found = 0, 0, 0
        if linked:
            some, altered = project_on_rows(rows, nodes, motion, sums)
        if calling:
            unsolved = call = solve_called(s, step)
            if call < FAILED:
                break
        if n_walls > 0:
            found, friction = project_on_walls(nodes, motion, walls, (touched, met), sums, pressed)
            near = pressed.nodes[:found]
            more, touched = compare_contacts(
                walls.touched.touching, touched, near, pressed.touching, walls.present, walls.releases
            )
            changes += more
        react(held, nodes, motion, sums)
        others = pressed_nodes(rows, some) if linked else s.called.held[: s.called.counts[0]]
        pressing = join_nodes(near, others, walls.present)
        work_of_contact(pressing, motion, sums)
        impact, met, call = lose_energy(s, step, (met, touched), altered)
        if call != 0:
            unsolved = np.int64(LOST)
            break
        s.ledger[_IMPACT] += impact
        for c in range(3 if len(s.springs.nodes) > 0 else 0):
            sums.forces[SUPPORTS, c] -= sums.springs[c]
        correct_moving(s.moving, step, held, nodes, motion, sums)
        if linked:
            sum_rows(rows, some)
        push_particles(sums.forces, pressed.force, rows.totals, motion.h, s.impulses, particles)
        if len(walls.motions) > 0:
            s.ledger[_PUSHED] += work_of_walls(step, walls, s.push, pressed.force)
        for k in range(n_walls):
            flags[step, k] = pressed.contacts[k] > 0
        done += 1
        passed += 1
        stops = changed > 0
        wrong = stops or failed >= 0 or pressed.failure[0] >= 0 or unsolved != 0
        wrong = wrong or not np.isfinite(sums.works[INTERNAL])
        looks = wrong or shortened
        if agree:
            looks, lost = any_rank(messages, looks, s.calls)
            if lost != 0:
                break
        if looks or last_one:
            if not (keeps or ending):
                restore_increments(nodes, motion, held)
            give_state(s.state, motion)
            if failed < 0 and shortened:
                turned = np.int64(first_inverted(s.state.x, s.state.before, s.bars.ends, s.bars.watched))
            wrong = wrong or turned >= 0
            put_rates(s.moving, step, held, s.state.v, s.state.a)
        if agree and looks:
            stops, lost = any_rank(messages, wrong, s.calls)
            if lost != 0:
                break
            wrong = wrong or stops
        if ending or wrong:
            accumulate(nodes, motion, pressing, sums)
            energies[_SPRINGS] = sums.springs[3]
            record_row(s, step, (len(pressing), changes), particles, energies, s.shares[recorded])
            changes = 0 if due[step] else changes
            recorded += 1
        for c in range(3):
            s.impulses.half[SUPPORT, c] += sums.jumps[0, c]
        for k in range(len(s.works)):
            s.works[k] += sums.works[k]
        if stops or (wrong and not several):
            break
    found = done, passed, recorded, lost, changed, failed, turned, unsolved, len(near), len(pressing)
    for k in range(len(outcome)):
        outcome[k] = found[k]
    return touched, met, changes, friction
