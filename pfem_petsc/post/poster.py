"""The instants of a run shown on a poster, and their layout on the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["grid", "instants"]


def instants(result: Any, frames: Sequence[int], count: int) -> list[int]:
    """Select snapshots: first, last, first contact, most deformed, and those that fill the longest gaps.

    Parameters
    ----------
    result : an open result, whose history has contact and deformation
    frames : snapshots to choose from
    count : maximum number of snapshots
    """
    frames = sorted(set(frames))
    if len(frames) <= count:
        return frames
    times = np.asarray(result.times, dtype=float)[frames]
    chosen = {0, len(frames) - 1}
    history = result.history
    when = np.asarray(history["time"], dtype=float)
    for name, pick in (("active_contacts", lambda v: np.argmax(v > 0)), ("elastic_energy", np.argmax)):
        values = np.asarray(history[name]) if name in history else np.zeros(0)
        if values.size and values.max() > 0:
            chosen.add(int(np.argmin(np.abs(times - when[int(pick(values))]))))
    while len(chosen) < count:
        have = np.array(sorted(chosen))
        distance = np.abs(np.arange(len(frames))[:, None] - have[None, :]).min(axis=1)
        chosen.add(int(np.argmax(distance)))
    return [frames[k] for k in sorted(chosen)]


def grid(count: int, aspect: float, room: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of tiles that make pictures of this aspect (width over height) largest."""

    def drawn_width(columns: int) -> float:
        rows = -(-count // columns)
        return min(room[0] / columns, aspect * room[1] / rows)

    columns = max(range(1, count + 1), key=lambda columns: (round(drawn_width(columns), 3), -columns))
    return columns, -(-count // columns)
