"""What a text selects of a history, or computes from it: columns, components, nodes, bars, and arithmetic with them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ..columns import declared
from ..errors import InputError
from ..registry import nearest
from .table import flat_columns
from .units import dimensions, powers_of, product, simplest

__all__ = ["Selected", "select"]


class Selected(NamedTuple):
    """Values of a history.

    Attributes
    ----------
    values : numbers (rows,), or of each member, the nodes or bars of a probe (rows, members); vectors have three
        components behind these dimensions
    unit : SI unit, empty for pure numbers; None if it is not known
    vector : whether they are vectors
    sources : the columns of the history that they come from; a number has none
    single : whether they are those of one column, or of a part of one
    """

    values: np.ndarray
    unit: str | None
    vector: bool = False
    sources: tuple[str, ...] = ()
    single: bool = False

    @property
    def plain(self) -> bool:
        """Whether it is a number without unit, which may have any."""
        return not self.sources and self.unit is None

    def reduced(self) -> Selected:
        """Return the mean over the members, of reactions the sum."""
        if self.values.ndim < 2 + self.vector:
            return self
        reactions = self.sources[0].endswith("/reaction")
        return self._replace(values=self.values.sum(axis=1) if reactions else self.values.mean(axis=1))

    def part(self, member: str | None, part: str | None, text: str) -> Selected:
        """Return the values of a member, by its number, and a component: x, y, z or norm; of bars min or max."""
        made, members = self, self.values.ndim == 2 + self.vector
        if member is not None:
            if not members or int(member) >= self.values.shape[1]:
                whole = self.sources[0] if self.single else "it"
                known = ", ".join(list(flat_columns(whole, self.values, self.vector))[:6])
                raise InputError(f"{text}: the column {whole} has {known}")
            made = made._replace(values=self.values[:, int(member)])
        if part is None:
            return made
        if part in ("min", "max"):
            if self.vector or not members or member is not None:
                raise InputError(f"{text}: .{part} is the least or largest of several bars of a probe in each row")
            return made._replace(values=getattr(self.values, part)(axis=1))
        if not self.vector:
            raise InputError(f"{text}: '{self.sources[0] if self.single else 'it'}' is a number and has no components")
        values = made.reduced().values
        values = np.linalg.norm(values, axis=1) if part == "norm" else values[:, "xyz".index(part)]
        return made._replace(values=values, vector=False)


def select(history: Mapping[str, np.ndarray], text: str) -> Selected:
    """Return what a text selects of a history, or computes from it.

    ``NAME[0]`` is the value of the first node or bar of a probe, and ``.x``, ``.y``, ``.z``, ``.norm`` are components;
    of all nodes, that of their mean, of reactions that of the sum. Of bars, ``.min`` and ``.max`` are the least and the
    largest in each row. ``probe/NAME/displacement`` is the position relative to that of the first row, and so
    ``wall/NAME/displacement`` and ``NAME/displacement`` of any column.

    These, numbers, and numbers with a unit, ``1.2e-3[m2]``, are combined with ``+ - * /`` and parentheses, which may
    have a component too. Where a name can begin, the longest one that the history has is taken, whatever signs it
    contains; then an operator comes. What is divided by zero is NaN.

    Raises
    ------
    InputError
        If the history has no such column, the column no such component or member, units of sums differ, or the text is
        no expression.
    """
    if not text.strip() or len(text) > _LONGEST:
        what = f"{len(text)} letters, at most {_LONGEST} are read" if text.strip() else "the expression is empty"
        raise InputError(f"a column of the history, or an expression of columns, is expected: {what}")
    reader = _Reader(history, text)
    try:
        found = reader.sum()
    except RecursionError:
        raise InputError(f"{text[:40]} ...: parentheses and signs within each other are too many") from None
    reader.skip()
    if reader.at < len(text):
        raise reader.error(f"expected +, -, * or / before '{text[reader.at :].strip()}'")
    if not found.sources:
        raise InputError(f"'{text}' names no column of the history")
    return found


_LONGEST = 2000
_MOVED = "/displacement"
_NUMBER = re.compile(r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_UNIT = re.compile(r"\s*\[([^\[\]]*)\]")
_PART = re.compile(r"(?:\[(?P<member>\d+)\])?(?:\.(?P<part>x|y|z|norm|min|max))?(?=\s|[-+*/)]|$)")
_UNKNOWN = re.compile(r"[^\s+*()]+(?:\s+(?![-+*/]\s)[^\s+*()]+)*")


class _Reader:
    """Reads an expression from left to right.

    Attributes
    ----------
    at : the place in the text that comes next
    """

    def __init__(self, history: Mapping[str, np.ndarray], text: str) -> None:
        self._history, self._text, self.at = history, text, 0
        self._names = dict(_names(history))
        self._longest_first = sorted(self._names, key=len, reverse=True)

    def error(self, why: str) -> InputError:
        """What is wrong with the text."""
        return InputError(f"{self._text}: {why}")

    def skip(self) -> str:
        """Skip blanks; return the next letter, an empty text at the end."""
        while self._text[self.at : self.at + 1].isspace():
            self.at += 1
        return self._text[self.at : self.at + 1]

    def _take(self, signs: str) -> str:
        """Return the next letter if it is one of these, and go on behind it."""
        sign = self.skip()
        if not sign or sign not in signs:
            return ""
        self.at += 1
        return sign

    def sum(self) -> Selected:
        found = self._product()
        while sign := self._take("+-"):
            found = self._added(found, self._product(), np.add if sign == "+" else np.subtract)
        return found

    def _product(self) -> Selected:
        found = self._factor()
        while sign := self._take("*/"):
            found = self._multiplied(found, self._factor(), -1 if sign == "/" else 1)
        return found

    def _factor(self) -> Selected:
        if sign := self._take("+-"):
            found = self._factor()
            return found._replace(values=-found.values, single=False) if sign == "-" else found
        if self._take("("):
            found = self.sum()
            if not self._take(")"):
                raise self.error("a ')' is missing")
            part = _PART.match(self._text, self.at)
            if part is None:
                raise self.error(f"expected .x, .y, .z, .norm or an operator: '{self._text[self.at :]}'")
            self.at = part.end()
            return found.part(*part.groups(), self._text)
        self.skip()
        return self._named() or self._number()

    def _named(self) -> Selected | None:
        """The longest known name that begins here, with its component."""
        for name in self._longest_first:
            part = _PART.match(self._text, self.at + len(name)) if self._text.startswith(name, self.at) else None
            if part is not None:
                self.at = part.end()
                source = self._names[name]
                values = np.asarray(self._history[source])
                if name != source:
                    values = values - values[:1]
                column = declared(source)
                made = Selected(values, column.unit, column.size == 3, (source,), True)
                return made.part(*part.groups(), self._text)
        return None

    def _number(self) -> Selected:
        number = _NUMBER.match(self._text, self.at)
        if number is None:
            raise self._unknown()
        self.at = number.end()
        unit = _UNIT.match(self._text, self.at)
        if unit is not None:
            self.at = unit.end()
        known = None if unit is None else simplest(powers_of(unit[1]))
        return Selected(np.asarray(float(number[0])), known)

    def _unknown(self) -> InputError:
        found = _UNKNOWN.match(self._text, self.at)
        if found is None:
            return self.error(f"a column or a number is missing at '{self._text[self.at :]}'")
        function = re.match(r"[A-Za-z]\w*(?=\s*\()", self._text[self.at :])
        if function is not None:
            signs = "expressions have + - * / and parentheses, and .norm of vectors"
            return self.error(f"'{function[0]}(...)': there are no functions; {signs}")
        whole = re.sub(r"(\[\d+\])?(\.(x|y|z|norm|min|max))?([-*/]\d[\d.e-]*)*$", "", found[0])
        hint = nearest(whole, [name for name in self._names if not _is_change(name, self._names[name])])
        return InputError(f"the history has no column '{whole}'{hint}")

    def _added(self, one: Selected, other: Selected, operation: Callable) -> Selected:
        one, other = one.reduced(), other.reduced()
        if one.vector != other.vector:
            raise self.error("one is a vector and the other is not; select a component, like .x")
        unit = one.unit if other.plain else other.unit if one.plain else _common(one.unit, other.unit)
        if unit is None and None not in (one.unit, other.unit):
            raise self.error(f"the units {one.unit or '1'} and {other.unit or '1'} differ")
        return Selected(operation(one.values, other.values), unit, one.vector, one.sources + other.sources)

    def _multiplied(self, one: Selected, other: Selected, power: int) -> Selected:
        one, other = one.reduced(), other.reduced()
        if other.vector and (one.vector or power < 0):
            raise self.error("a vector is multiplied and divided by numbers only; select a component, like .x")
        unit = None
        if one.unit is not None and other.unit is not None:
            unit = simplest(product((powers_of(one.unit), 1), (powers_of(other.unit), power)))
        a, b = (
            q.values[:, None] if q.values.ndim and not q.vector and p.vector else q.values
            for q, p in ((one, other), (other, one))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            values = a * b if power > 0 else np.where(b == 0.0, np.nan, a / b)
        return Selected(values, unit, one.vector or other.vector, one.sources + other.sources)


def _common(one: str | None, other: str | None) -> str | None:
    """Return the unit of both; None if one is not known, or their dimensions differ."""
    if one is None or other is None:
        return None
    return one if dimensions(powers_of(one)) == dimensions(powers_of(other)) else None


def _is_change(name: str, source: str) -> bool:
    return name == source + _MOVED


def _names(columns: Iterable[str]) -> Iterable[tuple[str, str]]:
    """Yield the names that can be selected, and the column of each."""
    for name in columns:
        if not name.startswith("event/"):
            yield name, name
            yield name + _MOVED, name
            if name.startswith(("probe/", "wall/")) and name.endswith("/position"):
                yield name.removesuffix("/position") + _MOVED, name
