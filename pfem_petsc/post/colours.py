"""Colours of a picture: a field of a result as one number per bar or node, its range and colour map, and marks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..output.units import field_unit, prefix_for
from ..registry import nearest

# Zero is a light grey, so that bars without a force recede, and the lightness falls with the magnitude on both sides.
DIVERGING = ("#0a3580", "#1f63b8", "#5f9bd1", "#b6bbc3", "#e8825a", "#c8312e", "#84101f")
SEQUENTIAL = ("#b6bbc3", "#eda540", "#dd5a3a", "#a3216b", "#3f0f5c")

GHOST = (208, 214, 222)
TRAILS = ((0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0))
"""Told apart with any colour vision (Okabe and Ito 2008)."""

_SIGNED = ("stress", "strain", "axial_force")
_COMPONENTS = {"x": 0, "y": 1, "z": 2, 0: 0, 1: 1, 2: 2}
_SAMPLES = 60  # maximum number of snapshots from which a range is determined


class Mark(NamedTuple):
    """How bars in a state are marked: by the field that tells, with a colour, and its text below the picture."""

    field: str
    colour: tuple[int, int, int]
    text: str


MARKS = {
    "broken": Mark("status", (0, 0, 0), "broken"),
    "yielded": Mark("plastic_strain", (240, 200, 30), "yielded"),
}


class ColourField:
    """A point or cell field of a result, reduced to one value per node or bar.

    Parameters
    ----------
    result : an open result
    name : name of a point or cell field
    component : "x", "y", "z" (or 0, 1, 2) of a vector field; None: its length

    Raises
    ------
    InputError
        For a field that the result does not have (with the nearest name), or a component that it does not have.

    Attributes
    ----------
    rounded : whether the last range was that of rounding errors of zero
    """

    def __init__(self, result: Any, name: str, component: str | int | None = None) -> None:
        point, cell = list(result.point_fields), list(result.cell_fields)
        if name not in point and name not in cell:
            raise InputError(f"render: the result holds no field '{name}'{nearest(name, point + cell)}")
        self.name, self.unit = name, field_unit(name)
        self.on_nodes = name in point
        vector = np.ndim(result.field(name, 0)) == 2
        if component is not None and (not vector or component not in _COMPONENTS):
            why = f"{component!r} is not one of x, y, z" if vector else "it has one value only"
            raise InputError(f"render: field '{name}' has no such component: {why}")
        self._component = _COMPONENTS[component] if component is not None else None
        self._result, self._rounding = result, _rounding_of(result, name)
        self.rounded = False
        title = name.replace("_", " ")
        self.title = f"{title} {'xyz'[self._component]}" if self._component is not None else title

    def values(self, index: int) -> np.ndarray:
        """Return the values of a snapshot, (nodes,) or (bars,) float64."""
        values = np.asarray(self._result.field(self.name, index), dtype=float)
        if values.ndim == 1:
            return values
        return np.linalg.norm(values, axis=1) if self._component is None else values[:, self._component]

    def limits(self, indices: Iterable[int]) -> tuple[float, float]:
        """Return the range for all frames: from zero, or symmetric about zero if there are negative values of more than
        a hundredth of it.

        In each snapshot one value in a hundred may lie outside (a spike at an impact would leave the rest without
        contrast), unless the full range is not much larger.
        """
        indices = list(indices)
        chosen = [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, _SAMPLES).astype(int))]
        shown = [values[np.isfinite(values)] for values in map(self.values, chosen)]
        sizes = [np.abs(values) for values in shown if values.size]
        bulk = max((float(np.quantile(size, 0.99)) for size in sizes), default=0.0)
        largest = max((float(size.max()) for size in sizes), default=0.0)
        lowest = min((float(values.min(initial=0.0)) for values in shown), default=0.0)
        limit = largest if largest <= 2.0 * bulk or bulk == 0.0 else bulk
        self.rounded = 0.0 < largest <= self._rounding
        if self.rounded or limit == 0.0:
            return (-1.0 if self.name in _SIGNED else 0.0), 1.0
        return (-limit if lowest < -0.01 * limit else 0.0), limit


def _rounding_of(result: Any, name: str) -> float:
    """Return below what a field of bars is rounding: of strains, that of coordinates over the length of a bar.

    A rod that flies without a force has stresses of 1e-6 Pa, which should not get all colours.
    """
    if name not in _SIGNED or not len(result.bars):
        return 0.0
    points = np.asarray(result.positions(0), dtype=float)
    ends = points[np.asarray(result.bars)]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    strain = 1e-13 * float(np.abs(points).max()) / max(float(np.median(length)), 1e-300)
    case = result.case
    moduli = [getattr(each, "young_modulus", None) or 0.0 for each in getattr(case, "material", {}).values()]
    areas = [each.area or 0.0 for each in getattr(case, "section", {}).values()]
    stress = strain * max(moduli, default=0.0)
    return {"strain": strain, "stress": stress, "axial_force": stress * max(areas, default=0.0)}[name]


class ColourScale:
    """Maps values to colours.

    Parameters
    ----------
    limits : lower and upper value
    cmap : a matplotlib colour map or its name; None: chosen by the sign of the lower limit
    unit : unit of the values

    Attributes
    ----------
    factor, unit : of the numbers beside the colours, and their unit with a prefix
    shown : maps values in that unit

    Raises
    ------
    InputError
        If the limits are not two increasing numbers, or for an unknown colour map.
    """

    def __init__(self, limits: tuple[float, float], cmap: Any = None, unit: str = "") -> None:
        import matplotlib
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        low, high = limits
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"render: colour limits {low:g}, {high:g} must be two finite, increasing numbers")
        if cmap is None:
            cmap = LinearSegmentedColormap.from_list("bars", DIVERGING if low < 0.0 else SEQUENTIAL)
            if low < 0.0:  # the part with zero at the grey, and equal magnitudes equally dark
                shares = 0.5 + 0.5 * np.linspace(low, high, 257) / max(-low, abs(high))
                cmap = LinearSegmentedColormap.from_list("bars", cmap(shares))
        elif isinstance(cmap, str):
            if cmap not in matplotlib.colormaps:
                raise InputError(f"render: unknown colour map '{cmap}'{nearest(cmap, list(matplotlib.colormaps))}")
            cmap = matplotlib.colormaps[cmap]
        self.factor, self.unit = prefix_for(max(abs(low), abs(high)), unit)
        self.shown = ScalarMappable(Normalize(low * self.factor, high * self.factor, clip=True), cmap)

    def colours(self, values: np.ndarray) -> np.ndarray:
        """Return colours (n, 3) uint8 of values (n,), clipped at the limits; NaN has the lowest colour."""
        low, high = self.shown.get_clim()
        return self.shown.to_rgba(np.nan_to_num(self.factor * values, nan=low, posinf=high, neginf=low), bytes=True)[
            :, :3
        ]


def limits_of(
    clim: tuple[float, float] | None, symmetric: bool, fields: Sequence[ColourField], frames: Sequence[int]
) -> tuple[float, float]:
    """Return the range of colours: the one given, or that of all fields, symmetric if asked for."""
    found = [clim] if clim is not None else [field.limits(frames) for field in fields]
    low, high = min(pair[0] for pair in found), max(pair[1] for pair in found)
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    return low, high
