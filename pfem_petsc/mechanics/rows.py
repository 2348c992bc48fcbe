"""Columns of a two-dimensional array as tuples in compiled loops, for a number of rows known at compile time.

The code is unrolled over rows and needs no reference counting: an array passed to an inner function costs more than a
bar, and a loop over a few rows cannot be vectorised over several bars.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic

from .compiled import inlined

__all__ = [
    "CHUNK",
    "accumulate",
    "bar_value",
    "blend",
    "differ",
    "extend",
    "keep_where",
    "known_ends",
    "new_rows",
    "put",
    "put_apart",
    "sum_where",
    "sum_with",
    "take",
]

CHUNK = 512
"""Bars whose working arrays fit into the fastest cache."""


@inlined
def new_rows(count):
    """Return ``count`` rows of :data:`CHUNK` numbers in one array, aligned to lines of the cache; not initialised."""
    room = np.empty(count * CHUNK + 8)
    return room[-(room.ctypes.data // 8) % 8 :]


def known_ends(builder: Any) -> Any:
    """Return the metadata of loads of the ends of bars, and of stores that do not overlap with them: without it
    compilers would have to compare all places before each loop."""
    module = builder.module
    return module.add_metadata([module.add_metadata(["pfem_petsc: ends of bars", module.add_metadata(["pfem_petsc"])])])


def _places(context: Any, builder: Any, signature: Any, args: Any, first: int, column: int, count: int) -> list[Any]:
    """Return pointers to ``count`` rows of a column; ``first``, ``column``: argument indices, -1 for row 0.

    A one-dimensional array holds rows of :data:`CHUNK` numbers. Their places are constants, so that compilers see that
    rows do not overlap.
    """
    array_type = signature.args[0]
    array = context.make_array(array_type)(context, builder, args[0])
    at = context.cast(builder, args[column], signature.args[column], types.intp)
    begin = context.get_constant(types.intp, 0)
    if first >= 0:
        begin = context.cast(builder, args[first], signature.args[first], types.intp)
    rows = (builder.add(begin, context.get_constant(types.intp, j)) for j in range(count))
    if array_type.ndim == 1:
        wide = context.get_constant(types.intp, CHUNK)
        return [builder.gep(array.data, [builder.add(builder.mul(row, wide), at)]) for row in rows]
    return [cgutils.get_item_pointer(context, builder, array_type, array, [row, at]) for row in rows]


@intrinsic
def bar_value(typingctx, values, bar):  # noqa: ANN001, ANN201 - Numba's types
    """Return ``values[bar]`` of an array, or ``values`` itself if it is a number, at no cost."""
    if not isinstance(values, types.Array):
        return values(values, bar), lambda context, builder, signature, args: args[0]

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        array = context.make_array(values)(context, builder, args[0])
        at = context.cast(builder, args[1], signature.args[1], types.intp)
        return builder.load(cgutils.get_item_pointer(context, builder, values, array, [at]))

    return values.dtype(values, bar), generate


@intrinsic
def take(typingctx, rows, column, like):  # noqa: ANN001, ANN201 - Numba's types
    """Return ``rows[0, column]``, ``rows[1, column]``, ... as a tuple of the length of ``like``."""
    count = len(like)

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        places = _places(context, builder, signature, args, -1, 1, count)
        loads = [builder.load(place) for place in places]
        for load in loads:
            load.set_metadata("alias.scope", known_ends(builder))
        return context.make_tuple(builder, signature.return_type, loads)

    return like(rows, column, like), generate


@intrinsic
def extend(typingctx, values, rows, first, column, like):  # noqa: ANN001, ANN201
    """Return a tuple with ``rows[first, column]``, ``rows[first + 1, column]``, ... added at its end, as many as
    ``like`` has; if it is empty, this is the tuple itself, and no code."""
    count = len(like)
    extended = types.BaseTuple.from_types((*values, *like)) if count else values

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        if count == 0:
            return impl_ret_borrowed(context, builder, signature.return_type, args[0])
        places = _places(context, builder, types.void(*signature.args[1:]), args[1:], 1, 2, count)
        parts = [builder.extract_value(args[0], j) for j in range(len(values))]
        parts += [builder.load(place) for place in places]
        made = context.make_tuple(builder, signature.return_type, parts)
        return impl_ret_borrowed(context, builder, signature.return_type, made)

    return extended(values, rows, first, column, like), generate


@intrinsic
def put(typingctx, rows, first, column, values):  # noqa: ANN001, ANN201
    """Write a tuple to ``rows[first, column]`` and the following rows."""
    count = len(values)

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        for j, place in enumerate(_places(context, builder, signature, args, 1, 2, count)):
            builder.store(builder.extract_value(args[3], j), place)
        return context.get_dummy_value()

    return types.void(rows, first, column, values), generate


@intrinsic
def accumulate(typingctx, rows, first, column, factor, values):  # noqa: ANN001, ANN201
    """Add ``factor`` times a tuple to ``rows[first, column]`` and the following rows."""
    count = len(values)

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        for j, place in enumerate(_places(context, builder, signature, args, 1, 2, count)):
            more = builder.fmul(args[3], builder.extract_value(args[4], j))
            builder.store(builder.fadd(builder.load(place), more), place)
        return context.get_dummy_value()

    return types.void(rows, first, column, factor, values), generate


@intrinsic
def put_apart(typingctx, rows, first, column, factor, values):  # noqa: ANN001, ANN201
    """Write ``factor`` times a tuple to ``rows[first, column]`` and the following rows, which do not overlap with what
    the functions of :mod:`~pfem_petsc.mechanics.columns` load."""
    count = len(values)

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        known = known_ends(builder)
        for j, place in enumerate(_places(context, builder, signature, args, 1, 2, count)):
            builder.store(builder.fmul(args[3], builder.extract_value(args[4], j)), place).set_metadata(
                "noalias", known
            )
        return context.get_dummy_value()

    return types.void(rows, first, column, factor, values), generate


@intrinsic
def differ(typingctx, one, other):  # noqa: ANN001, ANN201
    """Return whether two tuples of equal length differ or contain NaN."""
    count = len(one)

    def generate(context, builder, signature, args):  # noqa: ANN001, ANN202
        found = cgutils.false_bit
        for j in range(count):
            pair = (builder.extract_value(value, j) for value in args)
            found = builder.or_(found, builder.fcmp_unordered("!=", *pair))
        return found

    return types.boolean(one, other), generate


def _part(builder: Any, value: Any, j: int) -> Any:
    return builder.extract_value(value, j)


def _elementwise(combine: Callable[..., Any]) -> Any:
    """Make the code of an intrinsic whose result is a tuple, computed component by component."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        parts = [combine(builder, args, j) for j in range(len(signature.return_type))]
        return context.make_tuple(builder, signature.return_type, parts)

    return generate


@intrinsic
def blend(typingctx, condition, one, other):  # noqa: ANN001, ANN201
    """Return the tuple ``one`` if ``condition``, else ``other``, of equal length, without a branch."""

    def combine(builder: Any, args: Any, j: int) -> Any:
        return builder.select(args[0], _part(builder, args[1], j), _part(builder, args[2], j))

    return one(condition, one, other), _elementwise(combine)


@intrinsic
def sum_with(typingctx, one, factor, other):  # noqa: ANN001, ANN201
    """Return ``one + factor * other`` for tuples of equal length."""

    def combine(builder: Any, args: Any, j: int) -> Any:
        return builder.fadd(_part(builder, args[0], j), builder.fmul(args[1], _part(builder, args[2], j)))

    return one(one, factor, other), _elementwise(combine)


def keep_where(flags: tuple[bool, ...]) -> Any:
    """Make a function that returns a tuple with zeros where ``flags`` are false."""

    @intrinsic
    def keep(typingctx, values):  # noqa: ANN001, ANN202
        def combine(builder: Any, args: Any, j: int) -> Any:
            return _part(builder, args[0], j) if flags[j] else ir.Constant(ir.DoubleType(), 0.0)

        return values(values), _elementwise(combine)

    return keep


def sum_where(flags: tuple[bool, ...]) -> Any:
    """Make a function that returns the sum of the components of a tuple whose ``flags`` are true."""

    @intrinsic
    def total(typingctx, values):  # noqa: ANN001, ANN202
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            parts = [_part(builder, args[0], j) for j, wanted in enumerate(flags) if wanted]
            found = ir.Constant(ir.DoubleType(), 0.0)
            for k, part in enumerate(parts):
                found = builder.fadd(found, part) if k else part
            return found

        return types.float64(values), generate

    return total
