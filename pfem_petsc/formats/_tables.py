"""Tables of a case from values of nodes or bars: those with the same values make a group."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import numpy as np


def name_of(groups: dict[str, np.ndarray], members: np.ndarray, wanted: str) -> str:
    """Return the name of the group with these members, perhaps a new one: ``wanted``, or with a number after it."""
    for name in (wanted, *groups):
        if name in groups and np.array_equal(groups[name], members):
            return name
    name = free_name(groups, wanted)
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
