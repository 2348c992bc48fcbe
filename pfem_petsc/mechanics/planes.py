"""Passes over diagonal runs of bars whose nodes are stored by components, for compiled loops.

Positions and forces are kept in *planes*: all x, all y and all z of the local nodes, which follow each other in one
array (3 n,). The ends of a diagonal run are strips of consecutive numbers of each plane, which are loaded, subtracted
and added eight at a time, without the permutations that vectors x y z need.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from .compiled import borrowing
from .rows import known_ends
from .strips import Arguments, Strip, for_strips, separate, weave

__all__ = [
    "add_rows",
    "address",
    "aligned",
    "copy_run",
    "difference_of_ends",
    "join_planes",
    "new_planes",
    "number_at",
    "slide_planes",
    "split_planes",
    "subtract_rows",
]

_AXES = range(3)
_LINE = 8  # numbers in a line of the cache


def aligned(count: int) -> np.ndarray:
    """Return ``count`` zeros, aligned to lines of the cache."""
    room = np.zeros(count + _LINE)
    first = -(room.ctypes.data // room.itemsize) % _LINE
    return room[first : first + count]


def new_planes(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return planes (3 stride,) for positions and forces of ``nodes`` nodes, and for columns without a bar beyond them;
    aligned to lines of the cache."""
    stride = -(-nodes // _LINE) * _LINE + 2 * _LINE if nodes else 0
    return aligned(3 * stride), aligned(3 * stride)


@intrinsic
def address(typingctx, values, index):  # noqa: ANN001, ANN201
    """Return the address of ``values[index]``."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        return builder.ptrtoint(given.numbers(0, given.index(1)), ir.IntType(64))

    return types.int64(values, index), generate


@intrinsic
def number_at(typingctx, place, index):  # noqa: ANN001, ANN201
    """Return number ``index`` behind the address ``place``; see :func:`difference_of_ends`."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        pointer = builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())
        load = builder.load(builder.gep(pointer, [given.index(1)]))
        load.set_metadata("alias.scope", known_ends(builder))
        return load

    return types.float64(place, index), generate


@intrinsic
def difference_of_ends(typingctx, low, high, stride, bar):  # noqa: ANN001, ANN201
    """Return the end difference (dx, dy, dz) of a bar: that of the numbers ``bar`` behind the addresses ``high`` and
    ``low``, of planes with ``stride`` numbers.

    Compilers assume that :func:`~pfem_petsc.mechanics.rows.put_apart` does not change these numbers.
    """

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        kind, known, found = ir.DoubleType().as_pointer(), known_ends(builder), []
        for c in _AXES:
            at = builder.add(given.index(3), builder.mul(given.index(2), ir.Constant(ir.IntType(64), c)))
            loads = [builder.load(builder.gep(builder.inttoptr(arguments[k], kind), [at])) for k in (0, 1)]
            for load in loads:
                load.set_metadata("alias.scope", known)
            found.append(builder.fsub(loads[1], loads[0]))
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.float64, 3)(low, high, stride, bar), generate


def _change_planes(sign: str) -> Any:
    """Make the intrinsic that adds the first three rows of a workspace to planes, or subtracts them."""

    @intrinsic
    def change(typingctx, f, stride, node, count, work, first):  # noqa: ANN001, ANN202
        def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
            given = Arguments(context, builder, signature, values)
            combine = getattr(builder, sign)
            ends = [given.plane(0, given.index(2), given.index(1), c) for c in _AXES]
            rows = [given.row(4, given.index(5), c) for c in _AXES]

            def body(at: Any, strip: Strip) -> None:
                for end, row in zip(ends, rows, strict=True):
                    strip.store(combine(strip.load(end, at), strip.load(row, at)), end, at)

            for_strips(builder, given.index(3), body, ends[0])
            return context.get_dummy_value()

        return types.void(f, stride, node, count, work, first), generate

    return change


add_rows, subtract_rows = _change_planes("fadd"), _change_planes("fsub")


@intrinsic
def copy_run(typingctx, values, first, copy, at, count):  # noqa: ANN001, ANN201
    """Write ``count`` numbers of ``values`` (n,) from ``first`` on to ``copy`` (m,) from ``at`` on."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, arguments)
        source, target = given.numbers(0, given.index(1)), given.numbers(2, given.index(3))
        for_strips(builder, given.index(4), lambda place, strip: strip.store(strip.load(source, place), target, place))
        return context.get_dummy_value()

    return types.void(values, first, copy, at, count), generate


@intrinsic
def split_planes(typingctx, x, first, count, planes, stride, base):  # noqa: ANN001, ANN201
    """Write the vectors of ``count`` nodes of ``x`` (n, 3), from ``first`` on, to ``planes`` (3 stride,), which begin
    at node ``base``."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        first = given.index(1)
        nodes = given.numbers(0, first, 3)
        ends = [given.plane(3, builder.sub(first, given.index(5)), given.index(4), c) for c in _AXES]

        def body(at: Any, strip: Strip) -> None:
            for end, component in zip(ends, separate(builder, strip.load_nodes(nodes, at)), strict=True):
                strip.store(component, end, at)

        for_strips(builder, given.index(2), body)
        return context.get_dummy_value()

    return types.void(x, first, count, planes, stride, base), generate


@intrinsic
def join_planes(typingctx, planes, stride, base, first, count, f, row):  # noqa: ANN001, ANN201
    """Write the vectors of ``count`` nodes from ``first`` on in ``planes`` (3 stride,), which begin at node ``base``,
    to ``f`` (n, 3), from ``row`` on."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        first = given.index(3)
        ends = [given.plane(0, builder.sub(first, given.index(2)), given.index(1), c) for c in _AXES]
        nodes = given.numbers(5, given.index(6), 3)

        def body(at: Any, strip: Strip) -> None:
            strip.store_nodes(weave(builder, [strip.load(end, at) for end in ends]), nodes, at)

        for_strips(builder, given.index(4), body)
        return context.get_dummy_value()

    return types.void(planes, stride, base, first, count, f, row), generate


@borrowing
def slide_planes(planes, shift, count):
    """Move ``count`` nodes of ``planes`` (3 stride,) from ``shift`` on to the beginning."""
    stride = len(planes) // 3
    for c in range(3):
        one, other = planes[c * stride : c * stride + count], planes[c * stride + shift :]
        for i in range(len(one)):
            one[i] = other[i]
