"""Products with the stiffness of diagonal runs of bars by vector instructions, for compiled loops.

As in :mod:`~pfem_petsc.mechanics.strips` eight nodes of a strip are three vectors x y z x y z ... in memory. Only the
products of end differences are separated into components, for their sums; all else stays in the order of memory.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from .strips import LANES, NUMBERS, Arguments, Strip, add_to_both, chosen, separate

__all__ = ["add_stiffness_diagonals", "add_stiffness_products"]


def _spread(builder: Any, values: Any) -> list[Any]:
    """Return numbers of eight nodes for each of their components: a a a b b b ..."""
    nothing = ir.Constant(NUMBERS, ir.Undefined)
    places = [[(LANES * part + j) // 3 for j in range(LANES)] for part in range(3)]
    return [builder.shuffle_vector(values, nothing, chosen(*some)) for some in places]


@intrinsic
def add_stiffness_products(typingctx, x, u, out, low, high, count, along, across, first):  # noqa: ANN001, ANN201
    """Add (c d d^T + g I) w of ``count`` bars to the nodes of ``out`` (n, 3) from ``high`` on, and subtract it from
    those from ``low`` on; d and w: end differences of ``x`` and ``u`` (n, 3), c and g: ``along`` and ``across`` from
    ``first`` on."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        low, high, first = given.index(3), given.index(4), given.index(8)
        ends = [[given.numbers(k, node, 3) for node in (low, high)] for k in range(3)]
        factors = [given.numbers(k, first) for k in (6, 7)]

        def difference(of: list[Any], at: Any, strip: Strip) -> list[Any]:
            one, other = (strip.load_nodes(end, at) for end in of)
            return [builder.fsub(b, a) for a, b in zip(one, other, strict=True)]

        def pull(at: Any, strip: Strip) -> list[Any]:
            d, w = difference(ends[0], at, strip), difference(ends[1], at, strip)
            px, py, pz = separate(builder, [builder.fmul(a, b) for a, b in zip(d, w, strict=True)])
            c, g = (strip.load(factor, at) for factor in factors)
            c = builder.fmul(c, builder.fadd(builder.fadd(px, py), pz))
            parts = zip(_spread(builder, c), d, _spread(builder, g), w, strict=True)
            return [builder.fadd(builder.fmul(a, b), builder.fmul(e, f)) for a, b, e, f in parts]

        add_to_both(builder, ends[2], builder.sub(high, low), given.index(5), pull)
        return context.get_dummy_value()

    return types.void(x, u, out, low, high, count, along, across, first), generate


@intrinsic
def add_stiffness_diagonals(typingctx, x, minus, plus, low, high, count, along, across, first):  # noqa: ANN001, ANN201
    """Add the diagonals of c d d^T + g I of ``count`` bars to the nodes of ``plus`` (n, 3) from ``high`` on, and
    subtract them from those of ``minus`` (n, 3) from ``low`` on; see :func:`add_stiffness_products`."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        low, high, first = given.index(3), given.index(4), given.index(8)
        strips = [given.numbers(0, node, 3) for node in (low, high)]
        ends = [given.numbers(1, low, 3), given.numbers(2, high, 3)]
        factors = [given.numbers(k, first) for k in (6, 7)]

        def pull(at: Any, strip: Strip) -> list[Any]:
            one, other = (strip.load_nodes(end, at) for end in strips)
            d = [builder.fsub(b, a) for a, b in zip(one, other, strict=True)]
            c, g = (_spread(builder, strip.load(factor, at)) for factor in factors)
            return [builder.fadd(builder.fmul(b, builder.fmul(a, a)), e) for a, b, e in zip(d, c, g, strict=True)]

        add_to_both(builder, ends, builder.sub(high, low), given.index(5), pull)
        return context.get_dummy_value()

    return types.void(x, minus, plus, low, high, count, along, across, first), generate
