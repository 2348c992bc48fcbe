"""Tables of named columns of one length, and what a text selects of a history, or computes from it."""

from __future__ import annotations

import csv
import html
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..columns import declared
from ..errors import InputError, written
from ..registry import nearest
from .units import dimensions, powers_of, product, simplest

if TYPE_CHECKING:
    import pandas

__all__ = ["SWEEP", "Selected", "Table", "aligned", "flat_columns", "html_table", "select", "varied"]


_SHOWN = 10  # rows shown at the beginning and at the end of a long table
_COLUMNS = 12  # columns shown of a wide one


class Table(dict[str, np.ndarray]):
    """Named columns of one length: ``table["time"]`` is an array (rows,).

    Parameters
    ----------
    columns : arrays (rows,) by name, in order
    """

    def __init__(self, columns: Mapping[str, Sequence[Any] | np.ndarray]) -> None:
        super().__init__((name, _column(values)) for name, values in columns.items())
        self.n_rows = len(next(iter(self.values()), ()))
        for name, values in self.items():
            if len(values) != self.n_rows:
                raise InputError(f"table: column {name!r} has {len(values)} rows, expected {self.n_rows}")

    def __missing__(self, name: str) -> np.ndarray:
        raise KeyError(f"table has no column {name!r}{nearest(str(name), list(self))}")

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows as dictionaries."""
        return [{name: values[i] for name, values in self.items()} for i in range(self.n_rows)]

    def where(self, rows: np.ndarray | slice) -> Table:
        """Return a table of some rows, given by numbers, as a slice, or as a boolean mask (rows,)."""
        return Table({name: values[rows] for name, values in self.items()})

    def to_structured(self) -> np.ndarray:
        """Return a structured array (rows,) with a field for each column."""
        return np.rec.fromarrays(list(self.values()), names=list(self))

    def to_pandas(self) -> pandas.DataFrame:
        """Return a data frame.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise InputError(
                f"to_pandas needs pandas: pip install pandas ({error}); to_csv and to_structured do not"
            ) from error
        return pandas.DataFrame(dict(self))

    def to_csv(self, path: Path | str) -> Path:
        """Write the table with a heading, numbers exact to the last digit; an earlier file is replaced.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        path = Path(path)
        with written(path, "the table"), path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(self)
            lists = [[_plain(value) for value in values.tolist()] for values in self.values()]
            writer.writerows(zip(*lists, strict=True))
        return path

    def to_markdown(self, path: Path | str | None = None) -> str:
        """Return the table as text of Markdown, and write it to a file if one is given; an earlier file is replaced.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        lines = [list(self), ["---"] * len(self)]
        lines += [[_text(value) for value in row] for row in zip(*self.values(), strict=True)]
        text = "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)
        if path is not None:
            with written(Path(path), "the table"):
                Path(path).write_text(text, encoding="utf-8")
        return text

    def to_html(self) -> str:
        """Return all rows as a table of HTML."""
        return html_table(([_text(value) for value in row] for row in zip(*self.values(), strict=True)), self)

    def _texts(self) -> tuple[list[list[str]], str]:
        """The heading and the shown rows as texts, and what is left out of a wide table: columns of zeros first."""
        shown, names = list(range(self.n_rows)), list(self)
        if self.n_rows > 2 * _SHOWN:
            shown = [*shown[:_SHOWN], -1, *shown[-_SHOWN:]]
        if len(names) > _COLUMNS:
            names = [name for name in names if self[name].dtype.kind in "OU" or np.any(self[name])][:_COLUMNS]
        lines = [names]
        lines += [["…"] * len(names) if i < 0 else [_text(self[name][i]) for name in names] for i in shown]
        left = [name for name in self if name not in names]
        told = ", ".join([*left[:3], "..."] if len(left) > 3 else left)
        return lines, f"and {len(left)} more column{'s' if len(left) > 1 else ''}: {told}" if left else ""

    def __str__(self) -> str:
        lines, more = self._texts()
        return f"{self._aligned(lines)}\n{more}".rstrip()

    def text(self, most: int | None = None) -> str:
        """Return all rows, or the first ones, as text in columns."""
        rows = itertools.islice(zip(*self.values(), strict=True), most)
        return self._aligned([list(self), *([_text(value) for value in row] for row in rows)])

    def _aligned(self, lines: Sequence[Sequence[str]]) -> str:
        widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
        return "\n".join("  ".join(f"{text:>{w}}" for text, w in zip(line, widths, strict=True)) for line in lines)

    def __repr__(self) -> str:
        return f"<Table of {self.n_rows} rows: {', '.join(self)}>"

    def _repr_html_(self) -> str:
        (head, *body), more = self._texts()
        below = f"{self.n_rows} rows. {more}".rstrip(" .")
        return f"{html_table(body, head)}<p>{below}</p>"


def aligned(entries: Iterable[tuple[str, str]]) -> list[str]:
    """Return labels and their texts as lines, with the texts below each other."""
    entries = list(entries)
    width = max((len(label) for label, _ in entries), default=0)
    return [f"  {label:{width}}  {text}" for label, text in entries]


def html_table(lines: Iterable[Iterable[str]], head: Iterable[str] = ()) -> str:
    """Return texts as a table of HTML; those that begin with a digit have the class ``number``."""
    kinds = {True: ' class="number"', False: ""}
    rows = (
        "".join(f"<td{kinds[re.match('[-−]?[0-9]', text) is not None]}>{html.escape(text)}</td>" for text in line)
        for line in lines
    )
    heading = "".join(f"<th>{html.escape(text)}</th>" for text in head)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<table><thead><tr>{heading}</tr></thead><tbody>{body}</tbody></table>"


def flat_columns(name: str, values: np.ndarray, vector: bool) -> dict[str, np.ndarray]:
    """Return columns (rows,) of numbers or vectors, also of each node or bar of a probe: ``name``, ``name[0].x``.

    ``values`` : (rows,) or (rows, members), of a ``vector`` with three components behind.
    """
    if values.ndim == 1:
        return {name: values}
    if vector and values.ndim == 2:
        return {f"{name}.{axis}": values[:, k] for k, axis in enumerate("xyz")}
    found: dict[str, np.ndarray] = {}
    for k in range(values.shape[1]):
        found |= flat_columns(f"{name}[{k}]", values[:, k], vector)
    return found


SWEEP = "sweep.csv"
"""Table of a sweep, beside the folders of its runs."""


def varied(folder: Path) -> dict[str, str]:
    """Return the values that a sweep gave to the run in a folder, by their keys; empty if it is no run of a sweep."""
    try:
        with (folder.parent / SWEEP).open(newline="", encoding="utf-8") as file:
            row = next(row for row in csv.DictReader(file) if f"{int(row['run']):04d}" == folder.name)
    except (OSError, KeyError, ValueError, StopIteration):
        return {}
    values = itertools.takewhile(lambda item: item[0] != "status", row.items())
    return {key: value for key, value in values if key != "run" and value != "nan"}


def _column(values: Sequence[Any] | np.ndarray) -> np.ndarray:
    """Return values as an array (rows,), of objects where they are none of numbers and texts."""
    if isinstance(values, np.ndarray) and values.ndim == 1:
        return values
    values = list(values)
    kinds = {np.asarray(value).dtype.kind if np.isscalar(value) else "O" for value in values}
    for known, dtype in (("iu", np.int64), ("iuf", np.float64), ("U", np.str_), ("b", bool)):
        if kinds <= set(known):
            return np.array(values, dtype=dtype)
    made = np.empty(len(values), dtype=object)
    for i, value in enumerate(values):
        made[i] = value  # one by one: lists of one length would be taken for further dimensions
    return made


def _plain(value: Any) -> Any:
    """Return an array as lists, which text has complete and with commas."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def _text(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
    text = "" if text == "nan" else text
    return text if len(text) <= 60 else f"{text[:57]}..."


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
        hint = nearest(whole, [name for name in self._names if name != self._names[name] + _MOVED])
        return InputError(f"the history has no column '{whole}'{hint}")

    def _added(self, one: Selected, other: Selected, operation: Callable) -> Selected:
        one, other = one.reduced(), other.reduced()
        if one.vector != other.vector:
            raise self.error("one is a vector and the other is not; select a component, like .x")
        units = [each.unit for each in (one, other) if not each.plain] or [None]
        if None not in units and dimensions(powers_of(units[0])) != dimensions(powers_of(units[-1])):
            raise self.error(f"the units {one.unit or '1'} and {other.unit or '1'} differ")
        unit = None if None in units else units[0]
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


def _names(columns: Iterable[str]) -> Iterable[tuple[str, str]]:
    """Yield the names that can be selected, and the column of each."""
    for name in columns:
        if not name.startswith("event/"):
            yield name, name
            yield name + _MOVED, name
            if name.startswith(("probe/", "wall/")) and name.endswith("/position"):
                yield name.removesuffix("/position") + _MOVED, name
