"""Tables: named columns of one length, for pandas, NumPy, CSV files and notebooks."""

from __future__ import annotations

import csv
import html
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, written
from ..registry import nearest

if TYPE_CHECKING:
    import pandas

__all__ = ["SWEEP", "Table", "flat_columns", "varied"]

_SHOWN = 10  # rows shown at the beginning and at the end of a long table
_COLUMNS = 12  # columns shown of a wide one


class Table(Mapping[str, np.ndarray]):
    """Named columns of one length: ``table["time"]`` is an array (rows,).

    Parameters
    ----------
    columns : arrays (rows,) by name, in order
    """

    def __init__(self, columns: Mapping[str, Sequence[Any] | np.ndarray]) -> None:
        self._columns = {name: _column(values) for name, values in columns.items()}
        self.n_rows = len(next(iter(self._columns.values()), ()))
        for name, values in self._columns.items():
            if len(values) != self.n_rows:
                raise InputError(f"table: column {name!r} has {len(values)} rows, expected {self.n_rows}")

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._columns:
            raise KeyError(f"table has no column {name!r}{nearest(str(name), list(self))}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows as dictionaries."""
        return [{name: values[i] for name, values in self.items()} for i in range(self.n_rows)]

    def where(self, rows: np.ndarray) -> Table:
        """Return a table of some rows, given by numbers or as a boolean mask (rows,)."""
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

    def to_parquet(self, path: Path | str) -> Path:
        """Write the table as a Parquet file.

        Raises
        ------
        InputError
            If pyarrow is not installed, or the file cannot be written.
        """
        try:
            from pyarrow import parquet, table
        except ImportError as error:
            raise InputError(f"to_parquet needs pyarrow: pip install pyarrow ({error}); to_csv does not") from error
        path = Path(path)
        with written(path, "the table"):
            parquet.write_table(table(dict(self)), path)
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
        rows = "".join(f"<tr>{''.join(f'<td>{html.escape(text)}</td>' for text in line)}</tr>" for line in body)
        heading = "".join(f"<th>{html.escape(text)}</th>" for text in head)
        below = f"{self.n_rows} rows. {more}".rstrip(" .")
        return f"<table><thead><tr>{heading}</tr></thead><tbody>{rows}</tbody></table><p>{below}</p>"


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
    logical = bool(values) and isinstance(values[0], bool | np.bool_)  # which are integers for Python
    plain = [(int | np.integer, np.int64), (int | float | np.number, np.float64), (str, np.str_)]
    for kind, dtype in [(bool | np.bool_, bool)] if logical else plain:
        if all(isinstance(value, kind) and isinstance(value, bool | np.bool_) == logical for value in values):
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
