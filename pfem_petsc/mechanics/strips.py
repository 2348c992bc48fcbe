"""Differences, sums and products over diagonal runs of bars by vector instructions, for compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from .tuples import ROW

LANES = 8
"""Numbers of a vector."""

_INT, _SHORT = ir.IntType(64), ir.IntType(32)
NUMBERS = ir.VectorType(ir.DoubleType(), LANES)
_INTS = ir.VectorType(_INT, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
_POINTER = NUMBERS.as_pointer()
_ZEROS = ir.Constant(NUMBERS, [0.0] * LANES)
_ALIGNED = ir.Constant(_SHORT, 8)  # bytes: the arrays are aligned to numbers, not to vectors
_LONG = 8 * LANES  # run for which a beginning apart pays
# below this distance of the ends [nodes] the vectors of both overlap
APART = 2 * LANES


def _number(value: int) -> ir.Constant:
    return ir.Constant(_INT, value)


def chosen(*values: int) -> ir.Constant:
    """Return the mask of a shuffle: the places of the numbers it takes."""
    return ir.Constant(ir.VectorType(_SHORT, LANES), list(values))


class Strip:
    """Loads and stores of eight numbers, or of the first ``left`` ones."""

    def __init__(self, builder: Any, left: Any = None) -> None:
        self.builder, self.left = builder, left

    def _at(self, pointer: Any, index: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(pointer, [index]), _POINTER)

    def _mask(self, limit: Any, first: int) -> Any:
        """Return the mask of numbers ``first``, ``first`` + 1, ... that are below ``limit``."""
        builder, undefined = self.builder, ir.Constant(_INTS, ir.Undefined)
        one = builder.insert_element(undefined, limit, ir.Constant(_SHORT, 0))
        every = builder.shuffle_vector(one, undefined, chosen(*[0] * LANES))
        return builder.icmp_signed("<", ir.Constant(_INTS, [_number(first + j) for j in range(LANES)]), every)

    def _masked(self, name: str, result: Any, *arguments: Any) -> Any:
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.masked.{name}.v8f64.p0v8f64")
        return self.builder.call(function, arguments)

    def load(self, pointer: Any, index: Any, width: int = 1, part: int = 0) -> Any:
        """Return eight numbers from ``index``, the vector ``part`` of those with ``width`` numbers for each node."""
        at = self._at(pointer, self.builder.add(index, _number(LANES * part)))
        if self.left is None:
            loaded = self.builder.load(at)
            loaded.align = 8
            return loaded
        mask = self._mask(self.builder.mul(self.left, _number(width)), LANES * part)
        return self._masked("load", NUMBERS, at, _ALIGNED, mask, _ZEROS)

    def store(self, values: Any, pointer: Any, index: Any, width: int = 1, part: int = 0) -> None:
        """Store eight numbers, see :meth:`load`."""
        at = self._at(pointer, self.builder.add(index, _number(LANES * part)))
        if self.left is None:
            self.builder.store(values, at).align = 8
            return
        mask = self._mask(self.builder.mul(self.left, _number(width)), LANES * part)
        self._masked("store", ir.VoidType(), values, at, _ALIGNED, mask)

    def load_nodes(self, pointer: Any, node: Any) -> list[Any]:
        """Return the vectors of eight nodes as they are in memory: x y z x y z ..."""
        index = self.builder.mul(node, _number(3))
        return [self.load(pointer, index, 3, part) for part in range(3)]

    def store_nodes(self, vectors: list[Any], pointer: Any, node: Any) -> None:
        """Store the vectors of eight nodes."""
        index = self.builder.mul(node, _number(3))
        for part in range(3):
            self.store(vectors[part], pointer, index, 3, part)


def separate(builder: Any, woven: list[Any]) -> list[Any]:
    """Return the components of eight nodes: x x x ..., y y y ..., z z z ..."""
    found = []
    for c in range(3):
        places = [3 * i + c for i in range(LANES)]
        both = [at if at < 2 * LANES else 0 for at in places]
        rest = [i if at < 2 * LANES else at - LANES for i, at in enumerate(places)]
        first = builder.shuffle_vector(woven[0], woven[1], chosen(*both))
        found.append(builder.shuffle_vector(first, woven[2], chosen(*rest)))
    return found


def weave(builder: Any, components: list[Any]) -> list[Any]:
    """Return the reverse of :func:`separate`."""
    woven = []
    for part in range(3):
        places = [divmod(LANES * part + j, 3) for j in range(LANES)]
        both = [node if c == 0 else LANES + node if c == 1 else 0 for node, c in places]
        rest = [LANES + node if c == 2 else j for j, (node, c) in enumerate(places)]
        first = builder.shuffle_vector(components[0], components[1], chosen(*both))
        woven.append(builder.shuffle_vector(first, components[2], chosen(*rest)))
    return woven


def for_strips(builder: Any, count: Any, body: Callable[[Any, Strip], None], stored: Any = None) -> None:
    """Generate a loop over ``count`` bars, eight at a time; ``body`` gets the first one of each.

    If ``count`` is large, the loop begins with fewer, so that it then stores at multiples of the vectors' size, from
    the pointer ``stored`` on.
    """
    begin = _number(0)
    if stored is not None:
        address = builder.lshr(builder.ptrtoint(stored, _INT), _number(3))
        ahead = builder.and_(builder.neg(address), _number(LANES - 1))
        begin = builder.select(builder.icmp_signed(">=", count, _number(_LONG)), ahead, begin)
        with builder.if_then(builder.icmp_signed(">", begin, _number(0))):
            body(_number(0), Strip(builder, begin))
    whole = builder.add(begin, builder.and_(builder.sub(count, begin), _number(-LANES)))
    with cgutils.for_range_slice(builder, begin, whole, _number(LANES), _INT) as (at, _):
        body(at, Strip(builder))
    left = builder.sub(count, whole)
    with builder.if_then(builder.icmp_signed(">", left, _number(0))):
        body(whole, Strip(builder, left))


class Arguments:
    """The arguments of an intrinsic."""

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any) -> None:
        self.context, self.builder, self.types, self.values = context, builder, signature.args, values

    def index(self, k: int) -> Any:
        """Return argument k as an index."""
        return self.context.cast(self.builder, self.values[k], self.types[k], types.intp)

    def numbers(self, k: int, first: Any, width: int = 1) -> Any:
        """Return a pointer to the numbers of node or bar ``first`` in array k."""
        data = self.context.make_array(self.types[k])(self.context, self.builder, self.values[k]).data
        return self.builder.gep(data, [self.builder.mul(first, _number(width))])

    def plane(self, k: int, node: Any, stride: Any, component: int) -> Any:
        """Return a pointer to a component of a node in array k (3 stride,), which holds all x, then all y, all z."""
        return self.numbers(k, self.builder.add(node, self.builder.mul(stride, _number(component))))

    def row(self, k: int, column: Any, number: int) -> Any:
        """Return a pointer into a row of a workspace."""
        return self.numbers(k, self.builder.add(column, _number(number * ROW)))


@intrinsic
def differences(typingctx, x, low, high, count, work, first):  # noqa: ANN001, ANN201 - Numba's types
    """Write x[high + i] - x[low + i] for ``count`` nodes of ``x`` (n, 3) to rows of a workspace from ``first`` on."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        ends = [given.numbers(0, given.index(k), 3) for k in (1, 2)]
        rows = [given.row(4, given.index(5), c) for c in range(3)]

        def body(at: Any, strip: Strip) -> None:
            one, other = (strip.load_nodes(end, at) for end in ends)
            for row, values in zip(
                rows, separate(builder, [builder.fsub(b, a) for a, b in zip(one, other, strict=True)]), strict=True
            ):
                strip.store(values, row, at)

        for_strips(builder, given.index(3), body)
        return context.get_dummy_value()

    return types.void(x, low, high, count, work, first), generate


def add_to_both(
    builder: Any, ends: list[Any], distance: Any, count: Any, pull: Callable[[Any, Strip], Any], first: int = 0
) -> None:
    """Generate the subtraction of what ``pull`` returns from the nodes of a strip, and the addition to the other;
    ``first``: which of both ends comes first where they are close. With 1, sums are those of a loop over the bars."""

    def add(strip: Strip, at: Any, which: int, pulls: list[Any]) -> None:
        combine = builder.fadd if which else builder.fsub
        old = strip.load_nodes(ends[which], at)
        strip.store_nodes([combine(a, b) for a, b in zip(old, pulls, strict=True)], ends[which], at)

    def both(at: Any, strip: Strip) -> None:
        pulls = pull(at, strip)
        add(strip, at, 0, pulls)
        add(strip, at, 1, pulls)

    with builder.if_else(builder.icmp_signed(">=", distance, _number(APART))) as (apart, close):
        with apart:
            for_strips(builder, count, both)
        with close:  # a load of what has just been stored at another place would have to wait
            for which in (first, 1 - first):
                for_strips(builder, count, lambda at, strip, which=which: add(strip, at, which, pull(at, strip)))


@intrinsic
def add_strips(typingctx, f, low, high, count, work, first):  # noqa: ANN001, ANN201
    """Subtract three rows of a workspace times the fourth one, for ``count`` bars from ``first`` on, from the nodes of
    ``f`` (n, 3) from ``low`` on, and add them to those from ``high`` on."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        low, high, first = given.index(1), given.index(2), given.index(5)
        rows = [given.row(4, first, c) for c in range(4)]

        def pull(at: Any, strip: Strip) -> list[Any]:
            *components, factor = (strip.load(row, at) for row in rows)
            return weave(builder, [builder.fmul(factor, component) for component in components])

        ends = [given.numbers(0, node, 3) for node in (low, high)]
        add_to_both(builder, ends, builder.sub(high, low), given.index(3), pull)
        return context.get_dummy_value()

    return types.void(f, low, high, count, work, first), generate


def _spread(builder: Any, values: Any) -> list[Any]:
    """Return numbers of eight nodes for each of their components: a a a b b b ..."""
    nothing = ir.Constant(NUMBERS, ir.Undefined)
    places = [[(LANES * part + j) // 3 for j in range(LANES)] for part in range(3)]
    return [builder.shuffle_vector(values, nothing, chosen(*some)) for some in places]


@intrinsic
def add_tangent_products(typingctx, x, u, out, low, high, count, along, across, inverse, first):  # noqa: ANN001, ANN201
    """Add (c n n^T + g I) w of ``count`` bars to the nodes of ``out`` (n, 3) from ``high`` on, and subtract it from
    those from ``low`` on; n and w: end differences of ``x``, times ``inverse``, and of ``u`` (n, 3); c and g: ``along``
    and ``across``, from ``first`` on as ``inverse``. To the bits of a loop over the bars in their order."""

    def generate(context, builder, signature, values):  # noqa: ANN001, ANN202
        given = Arguments(context, builder, signature, values)
        low, high, first = given.index(3), given.index(4), given.index(9)
        ends = [[given.numbers(k, node, 3) for node in (low, high)] for k in range(3)]
        factors = [given.numbers(k, first) for k in (6, 7, 8)]

        def difference(of: list[Any], at: Any, strip: Strip) -> list[Any]:
            one, other = (strip.load_nodes(end, at) for end in of)
            return [builder.fsub(b, a) for a, b in zip(one, other, strict=True)]

        def pull(at: Any, strip: Strip) -> list[Any]:
            d, w = difference(ends[0], at, strip), difference(ends[1], at, strip)
            c, g, inverse = (strip.load(factor, at) for factor in factors)
            d = [builder.fmul(a, b) for a, b in zip(d, _spread(builder, inverse), strict=True)]
            px, py, pz = separate(builder, [builder.fmul(a, b) for a, b in zip(d, w, strict=True)])
            c = builder.fmul(c, builder.fadd(builder.fadd(px, py), pz))
            parts = zip(_spread(builder, c), d, _spread(builder, g), w, strict=True)
            return [builder.fadd(builder.fmul(a, b), builder.fmul(e, f)) for a, b, e, f in parts]

        add_to_both(builder, ends[2], builder.sub(high, low), given.index(5), pull, 1)
        return context.get_dummy_value()

    return types.void(x, u, out, low, high, count, along, across, inverse, first), generate
