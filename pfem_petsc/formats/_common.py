"""What several formats need: numbers in texts, fast for large files, groups of equal values, and edges of faces."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh

_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)


def numbers_of(text: bytes) -> np.ndarray:
    """Return all numbers of a text, separated by white space, as float64: whole numbers are exact up to 2^53.

    Raises
    ------
    ValueError
        If there is anything else.
    """
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        # text other than numbers ends the parsing, with a warning in older NumPy and an error in newer versions
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            other = next((word for word in text.split() if not _NUMBER.fullmatch(word)), text.strip())
            raise ValueError(f"{shown(other)!r} is not a number") from None


class NumberStream:
    """Numbers of a text, or of binary data with a byte order, taken one after the other; a text has float64 alone."""

    def __init__(self, content: bytes, order: str) -> None:
        self._order, self._at = order, 0
        self._all = content if order else numbers_of(content).tobytes()

    @property
    def left(self) -> int:
        """How many bytes, of a text numbers, nothing has taken; white space at the end of a file is none."""
        rest = self._all[self._at :]
        return len(rest.strip()) if self._order else len(rest) // 8

    def take(self, n: int, *kinds: str) -> np.ndarray:
        """Return the next n rows of numbers of these types, with the fields ``0``, ``1``, ...

        Raises
        ------
        EOFError
            If there are not as many.
        """
        row = np.dtype([(f"{k}", self._order + kind if self._order else "f8") for k, kind in enumerate(kinds)])
        start, self._at = self._at, self._at + n * row.itemsize
        if not start <= self._at <= len(self._all):
            raise EOFError("it ends early")
        return np.ndarray((n,), row, self._all, start)


def number_of(text: str) -> float:
    """Return a number, NaN for another text; Fortran's exponents (1.D+3) are known."""
    try:
        return float(text.upper().replace("D", "E"))
    except ValueError:
        return float("nan")


def whole_numbers(values: np.ndarray, first: int, end: int, before: str, after: str) -> np.ndarray:
    """Return numbers as int64, from ``first`` to ``end`` - 1; a message about another has it between two texts."""
    wrong = values[~((values >= first) & (values < end) & (values == np.rint(values)))]
    if wrong.size:
        found = "nothing" if np.isnan(wrong.flat[0]) else f"{wrong.flat[0]:.15g}"
        raise InputError(before + found + after)
    return values.astype(np.int64)


def places_of(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where labels are among ascending ones, and whether they are there."""
    place = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    return place, known[place] == wanted if len(known) else np.zeros(wanted.shape, bool)


def shown(text: bytes) -> str:
    """Return the beginning of a text for messages."""
    return text[:60].decode("utf-8", "replace")


def name_of(groups: dict[str, np.ndarray], members: np.ndarray, wanted: str, among: Iterable[str] | None = None) -> str:
    """Return the name of the group with these members, of those ``among`` which it may be (None: all), perhaps a new
    one: ``wanted``, or with a number after it."""
    known = [name for name in ((wanted, *groups) if among is None else among) if name in groups]
    name = next((name for name in known if np.array_equal(groups[name], members)), "") or free_name(groups, wanted)
    groups[name] = members
    return name


def free_name(taken: dict[str, Any], wanted: str) -> str:
    """Return a name that is not taken: ``wanted``, or with a number after it."""
    return next(name for k in count(1) if (name := wanted if k == 1 else f"{wanted}_{k}") not in taken)


def alike(
    groups: dict[str, np.ndarray], values: np.ndarray, wanted: str | Callable[[list[float], np.ndarray], str]
) -> Iterator[tuple[list[float], str]]:
    """Yield the rows of values (n, k) that differ and are not zero, each with the name of the group that has it.

    ``wanted`` is the name of a new group, or gives it for a row and its members.
    """
    rows, which = np.unique(values, axis=0, return_inverse=True)
    for i in np.flatnonzero(rows.any(axis=1)):
        row, members = rows[i].tolist(), np.flatnonzero(which.ravel() == i)
        yield row, name_of(groups, members, wanted if isinstance(wanted, str) else wanted(row, members))


def edges(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different edges (n, 2) among the sides of polygons (m, 2), and the number (m,) of the edge of each."""
    ends = np.sort(pairs, axis=1).astype(np.int64)
    n = int(ends.max(initial=0)) + 1
    keys, number = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)
    return np.stack([keys // n, keys % n], axis=1), number.ravel()


def drop_bare_nodes(path: Path, mesh: WholeMesh) -> None:
    """Remove nodes where no bar ends from a mesh, and tell their number."""
    used, bars = np.unique(mesh.bars, return_inverse=True)
    left = len(mesh.points) - len(used)
    mesh.tell(left, f"{path}: left out {left} points where no bar ends")
    mesh.points, mesh.bars = mesh.points[used], bars.reshape(-1, 2)
    mesh.node_groups = {name: np.flatnonzero(np.isin(used, own)) for name, own in mesh.node_groups.items()}
    mesh.node_fields = {name: values[used] for name, values in mesh.node_fields.items()}
