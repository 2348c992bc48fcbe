"""Steps of central differences in one compiled call, as many as nothing outside needs: the phases in their order, the
messages between ranks, and this rank's shares of the rows of the history."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..columns import BAR_ENERGIES, HEAD, PROBED
from ..contact.self_contact import largest_move
from ..mechanics.compiled import addressed, inlined, kernel, record
from ..mechanics.elements import first_inverted
from ..mechanics.internal_forces import BarArrays, internal_forces
from ..mechanics.layout import clear, join_components, split_components
from ..mechanics.loads import LoadSchedule, set_forces
from ..mesh.exchange import Messages
from .called_walls import CLOSE, SOLVE, TOUCH, CalledWalls
from .contact_phase import PUSHED, ContactNodes, WallArrays
from .impact import join_nodes
from .impulses import SUPPORT, ContactSums, record_forces
from .phases import (
    CHANGED,
    COLLAPSED,
    CONTACT,
    DAMPING,
    DONE,
    EXTERNAL,
    HOLDS,
    INERTIAL,
    INFEASIBLE,
    INTERNAL,
    KINETIC,
    LOST,
    MPI_ERROR,
    NEAR,
    NEEDS_ENERGIES,
    PASSED,
    PRESSING,
    RECORDED,
    SHORTENED,
    SUPPORTS,
    TURNED,
    UNSOLVED,
    GroundSprings,
    Motion,
    MovingSupports,
    Nodes,
    Prescribed,
    StepSums,
    accumulate,
    clear_vector,
    displace,
    move,
    numerical_dissipation,
    put_rates,
    rates_of,
    work_of_contact,
)

HELD, CHANGING, CLOSED = range(3)  # places of numbers in CalledRows
WAY_LEFT, WAY, DRIFT, MOST = 0, 1, 2, 5  # places in StepArrays.asleep

record(Messages)  # which stands below the compiled loops


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
    """Rows of pairs and constraints, which Python solves (owned nodes n).

    Attributes
    ----------
    any : whether there are any; watched : whether steps without closed rows need no call
    nodes : (m,) those whose motion Python needs
    ends, normals, least : (2, p), (p, 3), (p,) of watched rows, n . (x_2 - x_1) >= least: nodes, unit directions and
        bounds [m]; none otherwise
    predictor, u : (n, 3) positions to which nodes move without forces, and increments; (0, 3) without rows
    held, changing : (n,) nodes on which rows press, ascending; nodes of rows whose force begins or ends
    counts : (3,) their numbers, and of watched rows that are closed
    loss : (2,) energy that closing rows lose, and that friction of rows dissipates in the next step [J]
    totals : (tables, 3) forces on the last nodes of the rows of each table [N]
    """

    any: bool
    watched: bool
    nodes: np.ndarray
    ends: np.ndarray
    normals: np.ndarray
    least: np.ndarray
    predictor: np.ndarray
    u: np.ndarray
    held: np.ndarray
    changing: np.ndarray
    counts: np.ndarray
    loss: np.ndarray
    totals: np.ndarray


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
    """Particles (rows, 3) of :mod:`~pfem_petsc.stepping.impulses`: the scheme's memory and their state. Their
    accelerations are the forces, of which the sums of steps, walls and rows are parts."""

    half: np.ndarray
    a: np.ndarray
    v: np.ndarray


@record
class Calls(NamedTuple):
    """Functions that the loop calls: of MPI, and one of Python, of a step and what to do, see
    :class:`~pfem_petsc.stepping.callers.Caller`."""

    start_all: Any
    wait_all: Any
    reduce_all: Any
    python: Any


@record
class Contacts(NamedTuple):
    """Contacts from step to step, which compiled steps assign.

    Attributes
    ----------
    touched, met : nodes (m,) that touch walls; that have touched walls and not left them
    changes : contacts that have closed or opened since the last row
    friction : energy that friction dissipates in the next step [J]
    near : nodes (m,) beyond walls, or that rebound
    others, pressing : nodes (m,) with contact forces of rows; these and ``near``
    impact : energy that contacts lose in the step [J]
    """

    touched: np.ndarray
    met: np.ndarray
    changes: int
    friction: float
    near: np.ndarray
    others: np.ndarray
    pressing: np.ndarray
    impact: float


@record
class StepArrays(NamedTuple):
    """All that compiled steps read and write. ``course`` are the numbers of :mod:`~pfem_petsc.stepping.phases`. The
    latter parts are: the sums of the ledger, of which the dissipations by impact and friction and the work of walls are
    added to; works (5,) of all balances; energies of bars; particles of impulses; the nodes of probes; forces of walls
    (w, 3) at the start [N]; energy of bars that touch, what they have lost [J], and their columns of a row (5,); of
    bars that are too far from each other to touch, by how much they may come closer until Python looks again, by how
    much they have at most [m], and the drift and bounds of :func:`~pfem_petsc.contact.self_contact.largest_move` (8,);
    and this rank's shares (m, width) of the rows of the steps that are due, and at last of the last step if it is not,
    see :class:`~pfem_petsc.columns.Share`."""

    contacts: Contacts
    course: np.ndarray
    nodes: Nodes
    motion: Motion
    held: Prescribed
    moving: MovingSupports
    springs: GroundSprings
    bars: StepBars
    loads: LoadSchedule
    walls: WallArrays
    called_walls: CalledWalls
    called: CalledRows
    sums: StepSums
    pressed: ContactNodes
    messages: Messages
    calls: Calls
    state: StateArrays
    ledger: np.ndarray
    works: np.ndarray
    energies: np.ndarray
    impulses: ImpulseArrays
    probes: np.ndarray
    push: np.ndarray
    touching: np.ndarray
    asleep: np.ndarray
    shares: np.ndarray


_RUBBED, _IMPACT = map(HEAD.first, ("friction_dissipation", "impact_dissipation"))
_EXTERNAL_WORK, _DAMPED, _NUMERICAL, _KINETIC = map(
    HEAD.first, ("external_work", "damping_dissipation", "numerical_dissipation", "kinetic_energy")
)
_MOMENTA, _SUPPORT, _ACTIVE = map(
    HEAD.first,
    (
        "momentum",  # followed by angular momentum and centre of mass
        "support_force",
        "active_contacts",
    ),
)
_BARS, _PROBED = HEAD.indices(BAR_ENERGIES), len(PROBED)
_ENERGIES, _SPRINGS = len(BAR_ENERGIES), BAR_ENERGIES.index("spring_energy")
_PAIRS = HEAD.first("self_contact/contacts")  # followed by overlap and force
_TOUCHING, _TOUCHED = map(BAR_ENERGIES.index, ("self_contact_energy", "self_contact_dissipation"))


BEGIN, SEND, TAKE, FORCES, PRESS, IMPACTS, BOOK, AGREE, END, RECORD = range(10)
"""When phases of a step are made: at its start; messages between ranks; forces and balance; contact and reactions;
contacts that close; the books of the step; agreement of ranks; where the state is needed; in a step with a row, at the
end of a call, and where something is wrong."""


@inlined
def _perform(when, phases, starts, s, step):
    """Make the phases of a step that are due at a time."""
    for k in range(starts[when], starts[when + 1]):
        phases[k](s, step)


@addressed
def send_positions(s, step):
    """Send positions of owned nodes and wait for those of ghosts."""
    messages, x, calls = s.messages, s.motion.x, s.calls
    for k in range(len(messages.rows)):
        for c in range(3):
            messages.leaving[k, c] = x[c, messages.rows[k]]
    lost = calls.start_all(np.int32(messages.count), messages.requests.ctypes)
    if lost == 0:
        lost = calls.wait_all(np.int32(messages.count), messages.requests.ctypes, messages.statuses.ctypes)
    s.course[MPI_ERROR] = lost


@addressed
def take_positions(s, step):
    """Update the ghosts, which follow the owned nodes, and their previous positions."""
    messages, x, before, n = s.messages, s.motion.x, s.state.before, len(s.nodes.mass)
    for k in range(len(messages.arriving)):
        for c in range(3):
            before[n + k, c] = x[c, n + k]
            x[c, n + k] = messages.arriving[k, c]


@addressed
def agree(s, step):
    """Find whether the condition holds on any rank. Collective."""
    mine, every, handles = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32), s.messages.handles
    mine[0] = s.course[HOLDS]
    s.course[MPI_ERROR] = s.calls.reduce_all(mine.ctypes, every.ctypes, np.int32(1), handles[0], handles[1], handles[2])
    s.course[HOLDS] = every[0] > 0


@addressed
def set_loads(s, step):
    """Set loads and gravity that vary."""
    set_forces(step, s.loads, s.nodes.mass, s.nodes.external.T)


@addressed
def evaluate_forces(s, step):
    """Compute internal forces, and the energies if they are needed."""
    bars, motion, course = s.bars, s.motion, s.course
    clear(motion.f)
    if course[NEEDS_ENERGIES] > 0:
        clear_vector(s.energies)
    laws = bars.full if course[NEEDS_ENERGIES] > 0 else bars.brief
    energies = s.energies[: len(s.energies) if course[NEEDS_ENERGIES] > 0 else 0]
    course[COLLAPSED], course[SHORTENED], course[CHANGED] = internal_forces(
        motion.x, motion.f, bars.arrays, laws, motion.h, np.bool_(True), energies
    )


@addressed
def touch_bars(s, step):
    """Have Python add the forces of bars that touch, unless none can have come near enough."""
    asleep, motion = s.asleep, s.motion
    if asleep[WAY_LEFT] > 0.0:
        way = 2.0 * motion.h * largest_move(motion.half, None, asleep[DRIFT : DRIFT + 3], asleep[MOST : MOST + 3])
        if asleep[WAY] + way < asleep[WAY_LEFT]:
            asleep[WAY] += way
            return
    if s.calls.python(step, TOUCH) != 0:
        s.course[UNSOLVED] = LOST


@inlined
def _any_broken(called, motion):
    """Return whether nodes would end beyond a watched row."""
    x, half, h = motion.x, motion.half, motion.h
    for r in range(len(called.least)):
        i, j, value = called.ends[0, r], called.ends[1, r], -called.least[r]
        for c in range(3):
            value += called.normals[r, c] * (x[c, j] - x[c, i] + h * (half[c, j] - half[c, i]))
        if not value >= 0.0:
            return True
    return False


@addressed
def solve_called(s, step):
    """Have Python solve the rows of a step."""
    called, motion = s.called, s.motion
    h, x, half, u = motion.h, motion.x, motion.half, motion.u
    if called.watched and called.counts[CLOSED] == 0 and not _any_broken(called, motion):
        return
    for i in called.nodes:
        for c in range(3):
            s.state.x[i, c], called.u[i, c] = x[c, i], u[c, i]
            called.predictor[i, c] = x[c, i] + (h * half[c, i] - u[c, i])
    s.course[UNSOLVED] = s.calls.python(step, SOLVE)
    for i in called.nodes:
        for c in range(3):
            if called.u[i, c] != u[c, i]:
                displace(c, i, called.u[i, c] - u[c, i], s.nodes, motion, s.sums)
    s.contacts.others = called.held[: called.counts[HELD]]


@addressed
def join_pressing(s, step):
    """Find all nodes with contact forces, the work of these, and what friction takes."""
    contacts = s.contacts
    contacts.friction += s.called.loss[1]
    contacts.pressing = join_nodes(contacts.near, contacts.others, s.walls.present)
    work_of_contact(contacts.pressing, s.motion, s.sums)


@addressed
def close_called(s, step):
    """Have Python find the energy that rows lose."""
    called = s.called
    if called.counts[CHANGING] > 0:
        for i in called.changing[: called.counts[CHANGING]]:
            rates_of(i, s.motion, s.state.v, s.state.a)
        put_rates(s.moving, step, s.held, s.state.v, s.state.a)
        if s.calls.python(step, CLOSE) != 0:  # the rows have been solved, so this is an error
            s.course[UNSOLVED] = LOST
        s.contacts.impact += called.loss[0]
        called.counts[CHANGING] = 0


@addressed
def book_springs(s, step):
    """Add the forces of springs to those of supports."""
    for c in range(3):
        s.sums.forces[SUPPORTS, c] -= s.sums.springs[c]


@addressed
def push_particles(s, step):
    """Advance the particles of the impulses by a step, with the forces of the balance, of walls and of rows."""
    for k in range(len(s.impulses.half)):
        for c in range(3):
            s.impulses.half[k, c] += s.motion.h * s.impulses.a[k, c]


@inlined
def _probed(s):
    """Return this rank's share of the row that is due, and its values of probes (p, 4, 3)."""
    row = s.shares[s.course[RECORDED]]
    return row, row[len(row) - 3 * _PROBED * len(s.probes) :].reshape(len(s.probes), _PROBED, 3)


@addressed
def sum_ends(s, step):
    """Find sums at the end of a step, and write motion and forces of supports and contact at the probes."""
    accumulate(s.nodes, s.motion, s.contacts.pressing, s.sums)
    motion, v, a, (_, values) = s.motion, s.state.v, s.state.a, _probed(s)
    for i in s.probes:
        rates_of(i, motion, v, a)
    put_rates(s.moving, step, s.held, v, a)
    for k in range(len(s.probes)):
        i = s.probes[k]
        for c in range(3):
            values[k, 0, c], values[k, 1, c], values[k, 2, c] = motion.x[c, i], v[i, c], a[i, c]
            values[k, 3, c] = s.held.reaction[i, c] + motion.contact[i, c]
    impulses = s.impulses
    for k in range(len(impulses.v)):
        for c in range(3):
            impulses.v[k, c] = impulses.half[k, c] - 0.5 * motion.h * impulses.a[k, c]


@addressed
def record_row(s, step):
    """Write this rank's share of the row of a step."""
    ledger, works, sums, energies, (row, _) = s.ledger, s.works, s.sums, s.energies, _probed(s)
    ends = sums.ends
    energies[_SPRINGS] = sums.springs[3]
    energies[_TOUCHING], energies[_TOUCHED] = s.touching[0], s.touching[1]
    for k in range(len(ledger)):
        row[k] = ledger[k]
    row[_PAIRS], row[_PAIRS + 1], row[_PAIRS + 2] = s.touching[2], s.touching[3], s.touching[4]
    stored = 0.0
    for k in range(_ENERGIES):
        row[_BARS[k]] = energies[k]
        stored += energies[k]
    row[_KINETIC] = ends[KINETIC]
    row[_EXTERNAL_WORK] = works[EXTERNAL] + ends[EXTERNAL]
    row[_DAMPED] = works[DAMPING] + ends[DAMPING]
    inertial, internal = works[INERTIAL] - ends[INERTIAL], works[INTERNAL] + ends[INTERNAL]
    excess = works[CONTACT] + ends[CONTACT] - ledger[PUSHED]
    row[_NUMERICAL] = numerical_dissipation(inertial, internal, stored, excess, ledger[_RUBBED] + ledger[_IMPACT])
    for c in range(3):
        row[_SUPPORT + c] = sums.forces[SUPPORTS, c]
        for k in range(3):
            row[_MOMENTA + 3 * k + c] = sums.momenta[k, c]
    row[_ACTIVE] = len(s.contacts.pressing)
    pressed = s.pressed
    contact = ContactSums(pressed.force, pressed.moment, pressed.contacts, s.walls.releases, s.called.totals)
    record_forces(s.impulses.v, contact, s.contacts.changes, row)


@addressed
def put_state(s, step):
    """Write the state at the end of a step: velocities and accelerations by the scheme alone, or of supports."""
    state, motion, h = s.state, s.motion, s.motion.h
    join_components(motion.x, state.x)
    join_components(motion.f, state.f)
    join_components(motion.half, state.half)
    join_components(motion.u, state.u)
    for i in range(len(state.half)):
        rates_of(i, motion, state.v, state.a)
        for c in range(3):
            state.before[i, c] = state.x[i, c] - (h * state.half[i, c] - state.u[i, c])
    put_rates(s.moving, step, s.held, state.v, state.a)


@kernel
def run_compiled(s, phases, starts, due, flags):
    """Make some steps, with bars of any law.

    Its arguments are StepArrays; the phases of a step, those of each time from one of the ``starts`` on; ``due``
    (count,) bool, the steps with a row; and ``flags`` (count, walls) bool, which receives the walls that are touched in
    each step. The state is that after the last step. Fewer steps are made where bars of any rank change their state of
    rupture, and where something fails, except on several ranks that need not agree: these make all steps then, as
    others wait for their messages. It returns the first four of Contacts.
    """
    contacts, course, motion, sums, pressed = s.contacts, s.course, s.motion, s.sums, s.pressed
    count, several, linked = len(due), s.messages.several, s.called.any
    calling = (linked and not s.called.watched) or s.called_walls.massive  # which ranks do together
    agrees = several and (s.bars.can_break or calling)  # ranks that make the same steps
    course[COLLAPSED] = course[TURNED] = course[INFEASIBLE] = -1
    split_components(s.state.x, motion.x)
    split_components(s.state.half, motion.half)
    for step in range(count):
        failed = course[COLLAPSED] >= 0 or course[TURNED] >= 0 or course[INFEASIBLE] >= 0
        if failed or (course[UNSOLVED] != 0 and not calling):
            # the other ranks still need messages, until all know of the failure
            _perform(SEND, phases, starts, s, step)
            course[PASSED] += 1
            if course[MPI_ERROR] != 0:
                break
            continue
        last_one = step == count - 1
        ending = due[step] or last_one
        for i in contacts.pressing:
            for c in range(3):
                motion.contact[i, c] = 0.0
        _perform(BEGIN, phases, starts, s, step)
        s.ledger[_RUBBED] += contacts.friction  # on the way that the balance before has determined
        contacts.friction = contacts.impact = 0.0
        move(motion.x, motion.h, motion.half)
        _perform(SEND, phases, starts, s, step)
        if course[MPI_ERROR] != 0:
            break
        _perform(TAKE, phases, starts, s, step)
        course[NEEDS_ENERGIES] = ending or s.bars.can_break  # a bar that breaks ends the steps
        _perform(FORCES, phases, starts, s, step)
        _perform(PRESS, phases, starts, s, step)
        _perform(IMPACTS, phases, starts, s, step)
        if course[UNSOLVED] == LOST:
            break
        s.ledger[_IMPACT] += contacts.impact
        _perform(BOOK, phases, starts, s, step)
        for k in range(flags.shape[1]):
            flags[step, k] = pressed.contacts[k] > 0
        course[DONE] += 1
        course[PASSED] += 1
        stops = course[CHANGED] > 0
        wrong = stops or course[COLLAPSED] >= 0 or course[INFEASIBLE] >= 0 or course[UNSOLVED] != 0
        wrong = wrong or not np.isfinite(sums.works[INTERNAL])
        course[HOLDS] = wrong or course[SHORTENED] > 0
        if agrees:  # whether any rank has to look at its state
            _perform(AGREE, phases, starts, s, step)
        looks = course[HOLDS] > 0
        if looks or last_one:
            _perform(END, phases, starts, s, step)
            if course[COLLAPSED] < 0 and course[SHORTENED] > 0:
                course[TURNED] = first_inverted(s.state.x, s.state.before, s.bars.ends, s.bars.watched)
            wrong = wrong or course[TURNED] >= 0
        if agrees and looks and course[MPI_ERROR] == 0:  # whether any rank found something wrong
            course[HOLDS] = wrong
            _perform(AGREE, phases, starts, s, step)
            stops = course[HOLDS] > 0
            wrong = wrong or stops
        if course[MPI_ERROR] != 0:
            break
        if ending or wrong:
            _perform(RECORD, phases, starts, s, step)
            contacts.changes = 0 if due[step] else contacts.changes
            course[RECORDED] += 1
        for c in range(3):
            s.impulses.half[SUPPORT, c] += sums.jumps[0, c]
        for k in range(len(s.works)):
            s.works[k] += sums.works[k]
        if stops or (wrong and not several):
            break
    course[NEAR], course[PRESSING] = len(contacts.near), len(contacts.pressing)
    return contacts.touched, contacts.met, contacts.changes, contacts.friction
