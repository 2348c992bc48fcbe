"""What walls and constraints of users return during a run: their errors, and numbers that are none, are failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import PfemError, SimulationFailure, raised

__all__ = ["checked"]


def checked(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    """Return a function of positions (m, ..., 3) with results (m, ...), or a tuple of them, as one that fails where it
    raises an exception or returns NaN at finite positions; no comparison would stop a node there.

    Raises
    ------
    SimulationFailure
        On this rank; it says ``what`` has failed.
    """

    def function_checked(x: np.ndarray, *more: np.ndarray) -> Any:
        try:
            found = function(x, *more)
            for part in found if isinstance(found, tuple) else (found,):
                if np.isnan(part).any():
                    _refuse(x, part, what)
        except PfemError:
            raise
        except Exception as error:  # noqa: BLE001 - of a user
            raise SimulationFailure(f"{what} {raised(error)}") from error
        return found

    return function_checked


def _refuse(x: np.ndarray, found: np.ndarray, what: str) -> None:
    given, wrong = (np.asarray(each).reshape(len(x), -1) for each in (x, found))
    at = np.flatnonzero(np.isfinite(given).all(axis=1) & np.isnan(wrong).any(axis=1))
    if len(at):
        shown = np.asarray(found)[at[0]].tolist(), x[at[0]].tolist()
        raise SimulationFailure(f"{what} returned {shown[0]} at {shown[1]}: it must return numbers everywhere")
