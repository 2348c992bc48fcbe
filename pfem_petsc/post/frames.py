"""Which snapshots of a result are frames of a film, and states between snapshots for slow motion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from ..errors import InputError

__all__ = ["MOST_FRAMES", "Resampled", "chosen_frames", "even_times"]

MOST_FRAMES = 300
"""Snapshots that are drawn without an option: more make a film of over ten seconds."""

_MOST = 20_000  # frames in slow motion
_STEPWISE = ("status",)  # fields whose numbers stand for words


def chosen_frames(
    frames: int | Iterable[int] | None,
    times: np.ndarray,
    note: Callable[[str], None],
    span: Sequence[float] | None = None,
) -> list[int]:
    """Return the numbers of the snapshots to draw.

    Raises
    ------
    InputError
        For numbers that the result does not have.
    """
    if len(times) == 0:
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    if span is not None:
        first, last = _checked(span, times)
        within = [int(k) for k in np.flatnonzero((times >= first) & (times <= last))]
        if not within:
            raise InputError(f"render: span = {first:g} {last:g} holds no snapshot; give a longer one, or rate")
    else:
        within = list(range(len(times)))
    count = len(within)
    if frames is None and count > MOST_FRAMES:
        note(f"{MOST_FRAMES} of {count} snapshots are drawn; ask for more with frames = {count}")
        frames = MOST_FRAMES
    if frames is None:
        return within
    if isinstance(frames, (int, np.integer)):
        if frames < 1:
            raise InputError(f"render: frames = {frames} must be positive; a list of numbers may count from the end")
        if frames == 1:
            return within[-1:]  # at the first one, most structures are at rest and look like their mesh
        return [within[int(k)] for k in np.unique(np.linspace(0, count - 1, min(int(frames), count)).round())]
    chosen = [int(k) for k in frames]
    for k in chosen:
        if not -len(times) <= k < len(times):
            raise InputError(f"render: frame {k} does not exist; the result holds snapshots 0 to {len(times) - 1}")
    if not chosen:
        raise InputError("render: frames is an empty list")
    return [k % len(times) for k in chosen]


def even_times(times: np.ndarray, rate: float, span: Sequence[float] | None) -> np.ndarray:
    """Return times at a rate [1/s] from the first snapshot to the last, or within a span.

    Raises
    ------
    InputError
        For a rate that makes no film.
    """
    if len(times) == 0:
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError(f"render: rate = {rate:g} frames per simulated second must be positive")
    first, last = (times[0], times[-1]) if span is None else _checked(span, times)
    count = (last - first) * rate + 1.0
    if not 2.0 <= count <= _MOST:
        raise InputError(
            f"render: rate = {rate:g} makes {count:.6g} frames of {first:g} to {last:g}; give 2 to {_MOST} frames"
        )
    return first + np.arange(int(count + 1e-9)) / rate


def _checked(span: Sequence[float], times: np.ndarray) -> tuple[float, float]:
    first, last = span
    if not (np.isfinite(first) and first < last and last >= times[0] and first <= times[-1]):
        raise InputError(
            f"render: span = {first:g} {last:g} must be two increasing times between {times[0]:g} and {times[-1]:g}"
        )
    return max(first, float(times[0])), min(last, float(times[-1]))


class Resampled:
    """A result at other times: positions and fields are linear between snapshots, and constant outside.

    Parameters
    ----------
    result : an open result
    times : (n,) [s]
    """

    def __init__(self, result: Any, times: np.ndarray) -> None:
        self._result, self.times = result, np.asarray(times, dtype=float)
        own = np.asarray(result.times, dtype=float)
        place = np.interp(self.times, own, np.arange(len(own)))
        self._before = np.minimum(place.astype(int), len(own) - 1)
        self._part = place - self._before

    def __getattr__(self, name: str) -> Any:
        return getattr(self._result, name)

    def positions(self, i: int) -> np.ndarray:
        """Positions (nodes, 3) [m] at a time."""
        return self._mixed(lambda k: np.asarray(self._result.positions(k), dtype=float), i)

    def field(self, name: str, i: int) -> np.ndarray:
        """A field at a time; the status of bars is that of the snapshot before."""
        if name in _STEPWISE:
            return self._result.field(name, int(self._before[i]))
        return self._mixed(lambda k: np.asarray(self._result.field(name, k), dtype=float), i)

    def _mixed(self, values: Callable[[int], np.ndarray], i: int) -> np.ndarray:
        k, part = int(self._before[i]), float(self._part[i])
        if part < 1e-9:
            return values(k)
        before = values(k)
        return before + part * (values(k + 1) - before)
