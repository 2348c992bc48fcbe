"""Contributions of a step to the sums of a history row: compiled formulas that single steps and the fused loop share.

The positions of the sums are those of :mod:`~pfem_petsc.output.sums`, integers at module level that are constants of
the machine code.
"""

from __future__ import annotations

from ..energies import BAR_ENERGIES
from ..mechanics.compiled import kernel
from ..output.sums import HEAD, PAIR, WALL
from .book_loops import WORKS
from .impulses import WALLS

__all__ = ["add_totals", "add_works", "fill_bars", "fill_links", "fill_probes", "fill_walls", "fill_works"]

_BARS = tuple(HEAD.first(name) for name in BAR_ENERGIES)
_EXTERNAL, _CONTACT = HEAD.first("external_work"), HEAD.first("contact_work")
_DAMPING, _THERMAL = HEAD.first("damping_dissipation"), HEAD.first("thermal_work")
_FRICTION, _IMPACT = HEAD.first("friction_dissipation"), HEAD.first("impact_dissipation")
_NUMERICAL, _TOTALS = HEAD.first("numerical_dissipation"), HEAD.first("momentum")
_WALL = WALL.width
_FORCE, _MOMENT, _IMPULSE = WALL.first("force"), WALL.first("moment"), WALL.first("impulse")
_TOUCHED, _RELEASES = WALL.first("contacts"), WALL.first("releases")
_PAIR, _PUSH = PAIR.width, PAIR.first("force")
_LINK_IMPULSE, _JUMP = PAIR.first("impulse"), PAIR.first("jump_impulse")
_BY_EXTERNAL, _BY_CONTACT, _BY_DAMPING, _BY_INERTIA, _BY_BARS = range(len(WORKS))


@kernel
def add_works(sums, works, stored, heating, impact, friction, work, given, weight, lost, jumped) -> None:
    """Add the works and dissipations of a step to the sums of a row [J].

    Parameters
    ----------
    sums : (HEAD.width,) in the layout of :data:`~pfem_petsc.output.sums.HEAD`
    works : (5,) see :data:`~pfem_petsc.stepping.book_loops.WORKS`
    stored : change of the energies of nodes and bars; heating : work of changing temperatures
    impact, friction : dissipations
    work, given, weight, lost : of walls: work on the truss of those that move as prescribed and of those with mass, of
        the weight of these, and their numerical dissipation
    jumped : energy that a treatment of impact gave to nodes
    """
    sums[_EXTERNAL] += works[_BY_EXTERNAL] + weight
    sums[_CONTACT] += work
    sums[_DAMPING] += works[_BY_DAMPING]
    sums[_THERMAL] += heating
    sums[_FRICTION] += friction
    sums[_IMPACT] += impact
    # the work of contact on nodes in excess of the work of walls and the losses by friction and impact
    left = works[_BY_CONTACT] + jumped - work - given + friction
    sums[_NUMERICAL] += works[_BY_INERTIA] + works[_BY_BARS] + heating - stored - left - impact + lost


@kernel
def fill_works(sums, powers, ends, held) -> None:
    """Write the works and dissipations of a leapfrog scheme up to the end of a step [J].

    Parameters
    ----------
    sums : (HEAD.width,) of a row; those of impact are complete
    powers : (5,) of the balances before, see :class:`~pfem_petsc.stepping.leapfrog_ledger.LeapfrogLedger`
    ends : (5,) of the last balance, see :func:`~pfem_petsc.stepping.balance_loops.book_row`
    held : energies of the bars
    """
    sums[_EXTERNAL] = powers[_BY_EXTERNAL] + ends[_BY_EXTERNAL]
    sums[_DAMPING] = powers[_BY_DAMPING] + ends[_BY_DAMPING]
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
def fill_probes(row, at, nodes, places, counts, x, v, a, contact, support) -> None:
    """Write positions, velocities, accelerations and reactions of this rank's probed nodes, from index ``at`` of a row.

    ``nodes`` (m,); ``places`` (m,) of the positions among the sums of all probes; ``counts`` (m,) numbers of nodes of
    the probes on all ranks; ``support`` (0, 3) if there are no supports.
    """
    supported = len(support) > 0
    for j in range(len(nodes)):
        i = nodes[j]
        first, size = at + places[j], 3 * counts[j]
        for c in range(3):
            row[first + c] = x[i, c]
            row[first + size + c] = v[i, c]
            row[first + 2 * size + c] = a[i, c]
            row[first + 3 * size + c] = contact[i, c] + (support[i, c] if supported else 0.0)
