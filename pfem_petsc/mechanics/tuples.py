"""Tuples in compiled loops whose number of components is known when a loop is made: written out, not looped over.

A loop over a few rows cannot be vectorised over several bars, and an array made for each bar would cost more than it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import overload

from .compiled import add_freely, borrowing

CHUNK = 512
"""Bars whose working arrays fit into the fastest cache."""

ROW = CHUNK + 88
"""Numbers from one row of a workspace to the next, of which :data:`CHUNK` are used. With a power of two, loads from a
row would wait for stores to others, whose addresses end with the same bits."""


@cache
def written_out(text: str, count: int, borrowed: bool = True) -> Callable[..., Any]:
    """Compile the function of a text in which each ``<part>`` is repeated for j = 0, 1, ... ``count`` - 1.

    ``{j}`` in a part is the number, ``{jC}`` that of the first element of row j of a workspace.
    """

    def repeat(part: re.Match) -> str:
        return "".join(part[1].replace("{jC}", str(j * ROW)).replace("{j}", str(j)) for j in range(count))

    names: dict[str, Any] = {"__name__": __name__, "add": add_freely}
    exec(re.sub("<(.*?)>", repeat, text, flags=re.DOTALL), names)  # noqa: S102 - of texts in the program
    function = names["function"]
    function.__qualname__ = f"written_out.<locals>.{function.__qualname__}"  # several of one name: see `_distinguish`
    return borrowing(function)


def take(count: int) -> Callable[..., Any]:
    """Make a function that returns ``rows[0, k]``, ``rows[1, k]``, ... as a tuple."""
    return written_out("def function(rows, k): return (<rows[{j}, k], >)", count)


def take_from(count: int) -> Callable[..., Any]:
    """Make a function that returns ``rows[first, k]``, ``rows[first + 1, k]``, ... as a tuple."""
    return written_out("def function(rows, first, k): return (<rows[first + {j}, k], >)", count)


def put(count: int) -> Callable[..., Any]:
    """Make a function that writes a tuple to number ``at`` of a row of a workspace, and of the following rows."""
    return written_out("def function(rows, at, values):\n    pass<\n    rows[at + {jC}] = values[{j}]>", count)


def put_into(count: int) -> Callable[..., Any]:
    """Make a function that writes a tuple to ``rows[first, k]``, ``rows[first + 1, k]``, ..."""
    return written_out(
        "def function(rows, first, k, values):\n    pass<\n    rows[first + {j}, k] = values[{j}]>", count
    )


def accumulate(count: int) -> Callable[..., Any]:
    """Make a function that adds ``factor`` times a tuple to what :func:`put` would overwrite."""
    text = "def function(rows, at, factor, values):\n    pass<\n    rows[at + {jC}] += factor * values[{j}]>"
    return written_out(text, count)


def differ(count: int) -> Callable[..., Any]:
    """Make a function that returns whether two tuples differ or contain NaN."""
    return written_out("def function(one, other): return False< | (one[{j}] != other[{j}])>", count)


def blend(count: int) -> Callable[..., Any]:
    """Make a function that returns the tuple ``one`` if ``condition``, else ``other``."""
    text = "def function(condition, one, other): return (<one[{j}] if condition else other[{j}], >)"
    return written_out(text, count)


def sum_up(count: int) -> Callable[..., Any]:
    """Make a function that returns the tuple of ``sums``, to which it adds ``factor`` times another tuple if it is
    ``real``; see :func:`~.compiled.add_freely`."""
    part = "add(sums[{j}], factor * values[{j}] if real else 0.0), "
    return written_out(f"def function(sums, real, factor, values): return (<{part}>)", count)


def sum_with(count: int) -> Callable[..., Any]:
    """Make a function that returns ``one + factor * other`` for tuples."""
    return written_out("def function(one, factor, other): return (<one[{j}] + factor * other[{j}], >)", count)


def bar_value(values: Any, bar: int) -> float:
    """Return ``values[bar]`` of an array, or ``values`` itself if it is a number, at no cost; for compiled loops."""
    return values[bar] if isinstance(values, np.ndarray) else values


@overload(bar_value, jit_options={"_nrt": False})
def _bar_value(values, bar):  # noqa: ANN001, ANN202 - Numba's types
    if isinstance(values, types.Array):
        return lambda values, bar: values[bar]
    return lambda values, bar: values
