"""Films of modes: the shapes swing about the state that they belong to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..output.result import open_result
from ..output.units import MODE, Axis
from .render import render

if TYPE_CHECKING:
    from ..output.result import Result

_LARGEST = 0.1  # of the extent of the truss: the largest displacement that is drawn
_PERIOD = 24  # frames of a period


class ModeFrames:
    """Modes as the snapshots of a result that :func:`~pfem_petsc.post.render.render` draws, a period each.

    The field ``amplitude`` is the length of a node's displacement relative to the largest.

    Parameters
    ----------
    result : an open result
    modes : numbers of the modes from 1; None: all
    period : frames of a period

    Raises
    ------
    InputError
        Where the result has no modes, or not these.
    """

    point_fields: Sequence[str] = ("amplitude",)
    cell_fields: Sequence[str] = ()
    axis: Axis = MODE

    def __init__(self, result: Result, modes: Sequence[int] | None = None, period: int = _PERIOD) -> None:
        if period < 4:
            raise InputError(f"render: {period} frames a period are too few for modes; give 4 or more")
        found = result.modes
        self._numbers = list(range(1, len(found) + 1)) if modes is None else list(modes)
        for number in self._numbers:
            if not 1 <= number <= len(found):
                raise InputError(f"render: mode {number} does not exist; the result holds modes 1 to {len(found)}")
        self._labels, self._period = [found.label(number - 1) for number in self._numbers], period
        self.path, self.case, self.bars = result.path, result.case, result.bars
        self._place = result.positions(-1)
        shapes = found.shape[np.array(self._numbers, dtype=int) - 1]
        sizes = np.linalg.norm(shapes, axis=2)
        largest = sizes.max(axis=1)
        self._amplitudes = sizes / largest[:, None]
        extent = float(np.linalg.norm(np.ptp(self._place, axis=0))) or 1.0
        self._shapes = shapes * (_LARGEST * extent / largest)[:, None, None]
        # walls are where they are at the end
        self.times = np.full(period * len(self._numbers), result.times[-1])
        self.history: Mapping[str, np.ndarray] = result.history

    def positions(self, i: int) -> np.ndarray:
        """Positions (nodes, 3) [m] of frame i."""
        mode, phase = divmod(i, self._period)
        return self._place + np.sin(2.0 * np.pi * phase / self._period) * self._shapes[mode]

    def field(self, name: str, i: int) -> np.ndarray:
        """The amplitudes (nodes,) of frame i."""
        return self._amplitudes[i // self._period]

    def caption(self, i: int) -> str:
        """The caption of frame i."""
        return self._labels[i // self._period]

    def instants(self, count: int) -> list[int]:
        """Frames for a page: the first modes where they are largest."""
        return [self._period * mode + self._period // 4 for mode in range(min(count, len(self._numbers)))]


def render_modes(
    result_path: Path | str,
    output: Path | str | None = None,
    *,
    modes: Sequence[int] | None = None,
    period: int = _PERIOD,
    **options: Any,
) -> list[Path]:
    """Draw the modes of a result as :func:`~pfem_petsc.post.render.render` draws its snapshots.

    Parameters
    ----------
    result_path : result file or its folder
    output : folder of the pictures; None: ``modes`` beside the result
    modes : numbers of the modes from 1; None: all
    period : frames of a period
    options : of ``render``, but for ``field``, ``component`` and ``frames``; ``scale`` 1 draws a tenth of the truss's
        extent as the largest displacement

    Returns
    -------
    The files written: poster, films, frames.

    Raises
    ------
    InputError
        As ``render``, and where the result has no such modes.
    """
    with open_result(result_path) as result:
        frames = ModeFrames(result, modes, period)
        folder = Path(output) if output is not None else result.path.parent / "modes"
        count = len(frames.times)
        return render(frames, folder, field="amplitude", frames=count, **{"clim": (0.0, 1.0)} | options)
