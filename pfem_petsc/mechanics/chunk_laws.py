"""A material law as a loop over a chunk of bars: compiled once, and called by all loops over bars as a first-class
function.

A loop of a law gets its numbers, the step, and a workspace with a row for each quantity: it reads strains, temperatures
and the history of the bars, and writes stresses and the new history. All quantities lie in one array at known
distances, so that compiled loops need not compare addresses.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
from numba import types
from numba.typed import List

from .compiled import COMPILED, inlined, kernel, law_kernel
from .materials.base import Law

CHUNK = 512
"""Bars whose workspace fits into the fastest cache."""

ROW = CHUNK + 24
"""Numbers from one row of a workspace to the next: rows do not all lie in the same lines of the cache."""

DX, DY, DZ, STRETCH, FACTOR, PULL, STRAIN, TEMPERATURE, STRESS, MODULUS, HISTORY = range(11)
"""Rows of the workspace: what loops over bars keep beside the laws (end differences [m], stretch, slope of the strain
over the length [1/m], N/l [N/m]); the strain minus the thermal one, the temperature above reference [K], stress and
modulus [Pa]; then the history of the bars, ``law.rows`` and ``law.bar_data``, and the energy densities [J/m3]."""

STRAIN0, TEMPERATURE0 = STRESS, MODULUS
"""Rows in which a loop over mean stresses finds strain and temperature at the start of the step."""

_VALUES = types.float64[::1]
LOOP = types.void(_VALUES, types.float64, _VALUES, types.int64)
"""Type of the loops of laws: numbers of the law, step [s], workspace (rows ROW,), and number of bars."""

_STRAIN, _TEMPERATURE, _STRESS, _MODULUS = (np.uint64(row * ROW) for row in (STRAIN, TEMPERATURE, STRESS, MODULUS))
_STRAIN0, _TEMPERATURE0 = _STRESS, _MODULUS

_LAW = types.FunctionType(LOOP)

# functions as arguments are marked so; this module and the loops that take its lists are all that uses them
warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)


def work_rows(law: Law) -> int:
    """Return the number of rows of the workspace of a law."""
    return densities_row(law) + len(law.energies)


def densities_row(law: Law) -> int:
    """Return the row of the first energy density in the workspace of a law."""
    return HISTORY + len(law.rows) + len(law.bar_data)


def flatten(numbers: tuple[Any, ...]) -> tuple[np.ndarray, tuple[Any, ...]]:
    """Return the numbers of a law as one array, and their form for :func:`law_loops`: tuples of tuples, of 0 for a
    number, and of the number of columns of a table (rows, columns), which lies at the end."""
    values: list[float] = []
    tables: list[tuple[int, np.ndarray]] = []

    def form_of(item: Any) -> Any:
        if isinstance(item, tuple):
            return tuple(map(form_of, item))
        if isinstance(item, np.ndarray):
            tables.append((len(values), item))
            values.extend((0.0, 0.0))
            return item.shape[1]
        values.append(float(item))
        return 0

    form = form_of(numbers)
    for at, table in tables:
        values[at : at + 2] = len(values), len(table)
        values.extend(table.ravel().tolist())
    return np.array(values), form


def _unpack(form: tuple[Any, ...], at: int) -> tuple[Callable[..., Any], int]:
    """Make the function that returns the numbers of a form from an array, in which they begin at a number; return it
    with the number of the next one."""
    if not form:

        @inlined
        def nothing(p):
            return ()

        return nothing, at
    before, at = _unpack(form[:-1], at)
    last = form[-1]
    if isinstance(last, tuple):
        within, end = _unpack(last, at)

        @inlined
        def with_tuple(p):
            return before(p) + (within(p),)  # noqa: RUF005 - tuples of Numba

        return with_tuple, end
    if last > 0:

        @inlined
        def with_table(p):
            first, count = np.int64(p[at]), np.int64(p[at + 1])
            return before(p) + (p[first : first + count * last].reshape((count, last)),)  # noqa: RUF005

        return with_table, at + 2

    @inlined
    def with_number(p):
        return before(p) + (p[at],)  # noqa: RUF005

    return with_number, at + 1


def _place(row: int) -> Any:
    """Return where a row begins in a workspace: indices without a sign need no treatment of negative ones."""
    return np.uint64(row * ROW)


def _take(first: int, count: int) -> Callable[..., Any]:
    """Make a function that returns number i of ``count`` rows as a tuple."""
    if count == 0:

        @inlined
        def nothing(work, i):
            return ()

        return nothing
    before, at = _take(first, count - 1), _place(first + count - 1)

    @inlined
    def taken(work, i):
        return before(work, i) + (work[at + i],)  # noqa: RUF005

    return taken


def _put(first: int, count: int) -> Callable[..., Any]:
    """Make a function that writes a tuple to number i of ``count`` rows."""
    if count == 0:

        @inlined
        def nothing(work, i, values):
            pass

        return nothing
    before, k = _put(first, count - 1), count - 1
    at = _place(first + k)

    @inlined
    def put(work, i, values):
        before(work, i, values)
        work[at + i] = values[k]

    return put


@cache
def law_loops(law: Law, form: tuple[Any, ...]) -> SimpleNamespace:
    """Make the loops of a law whose numbers have a form: ``brief`` writes stresses and the new history to the
    workspace, ``full`` moduli and energy densities too; ``mean`` writes the mean stresses of steps and their
    derivatives, and no history (None without mean stresses)."""
    response, mean_stress, by_rate, can_break = law.response, law.mean_stress, law.rate, law.rupture >= 0
    count, n_data, gone = len(law.internal), len(law.bar_data), _place(HISTORY + max(law.rupture, 0))
    last, last_stress = _place(HISTORY + count), _place(HISTORY + count + 1)
    numbers_of, _ = _unpack(form, 0)
    variables_of, put_variables = _take(HISTORY, count), _put(HISTORY, count)
    data_of, put_densities = _take(HISTORY + len(law.rows), n_data), _put(densities_row(law), len(law.energies))

    @inlined
    def respond(numbers, step, work, i):
        strain, rate = work[_STRAIN + i], 0.0
        if by_rate and step > 0.0:
            rate = (strain - work[last + i]) / step
        p = numbers + data_of(work, i) if n_data else numbers
        stress, modulus, new, densities = response(strain, rate, step, work[_TEMPERATURE + i], p, variables_of(work, i))
        if by_rate:  # they keep the stress of what is left of a bar
            whole = stress
            if can_break:
                left = 1.0 - abs(work[gone + i])
                whole = stress / left if left > 0.0 else 0.0
            work[last + i], work[last_stress + i] = strain, whole
        put_variables(work, i, new)
        work[_STRESS + i] = stress
        return modulus, densities

    @law_kernel
    def brief(p, step, work, n):
        numbers = numbers_of(p)
        for k in range(n):
            i = np.uint64(k)
            respond(numbers, step, work, i)

    @law_kernel
    def full(p, step, work, n):
        numbers = numbers_of(p)
        for k in range(n):
            i = np.uint64(k)
            modulus, densities = respond(numbers, step, work, i)
            work[_MODULUS + i] = modulus
            put_densities(work, i, densities)

    if mean_stress is None:
        return SimpleNamespace(brief=brief, full=full, mean=None)

    @law_kernel
    def mean(p, step, work, n):
        numbers = numbers_of(p)
        for k in range(n):
            i = np.uint64(k)
            strain0, strain = work[_STRAIN0 + i], work[_STRAIN + i]
            q = variables_of(work, i)
            given = numbers + data_of(work, i) if n_data else numbers
            if by_rate:
                stress0 = work[last_stress + i]
                if can_break:
                    stress0 *= 1.0 - abs(work[gone + i])
            else:
                stress0, _, _, _ = response(strain0, 0.0, 0.0, work[_TEMPERATURE0 + i], given, q)
            found, modulus = mean_stress(stress0, strain0, strain, step, work[_TEMPERATURE + i], given, q)
            work[_STRESS + i], work[_MODULUS + i] = found, modulus

    return SimpleNamespace(brief=brief, full=full, mean=mean)


def first_class(loops: Sequence[Callable[..., Any]], signature: Any = LOOP) -> Any:
    """Return loops of one signature, as those of laws are, compiled, in a list that other loops take as an argument,
    whichever and however many they are. The loops must be kept as long as it is used."""
    if not COMPILED:
        return list(loops)
    if not loops:
        return _none()
    one, append = _list_loops(types.FunctionType(signature))
    for loop in loops:
        loop.compile(signature.args)
    found = one(loops[0])
    for loop in loops[1:]:
        append(found, loop)
    return found


@cache
def _list_loops(kind: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return loops that begin a list of functions of a kind, and that append to it."""
    one, append = kernel(_one), kernel(_append)
    for loop, arguments in ((one, (kind,)), (append, (types.ListType(kind), kind))):
        loop.compile(arguments)
        loop.disable_compile()  # a function is otherwise an argument of a type of its own
    return one, append


@kernel
def _none():
    """Return an empty list of loops of laws."""
    return List.empty_list(_LAW)


def _one(loop: Any) -> Any:
    """Return a list of one loop."""
    loops = List()
    loops.append(loop)
    return loops


def _append(loops: Any, loop: Any) -> None:
    """Append a loop to a list."""
    loops.append(loop)


def evaluate(law: Law, numbers: tuple[Any, ...], strain: Any, temperature: Any, history: np.ndarray) -> np.ndarray:
    """Return the workspace (rows, n) after the evaluation of a law at strains (n,) minus the thermal ones, temperatures
    (n,) or a number, and the history (rows, n) of bars, at the step 0."""
    p, form = flatten(numbers)
    loop, n = law_loops(law, form).full, history.shape[1]
    out = np.zeros((work_rows(law), n))
    work = np.zeros((work_rows(law), ROW))
    out[STRAIN], out[TEMPERATURE], out[HISTORY : HISTORY + len(history)] = strain, temperature, history
    for first in range(0, n, CHUNK):
        part = out[:, first : first + CHUNK]
        work[:, : part.shape[1]] = part
        loop(p, 0.0, work.reshape(-1), part.shape[1])
        part[:] = work[:, : part.shape[1]]
    return out
