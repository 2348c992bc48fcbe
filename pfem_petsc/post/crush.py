"""Figures of a crush test: stress and strain of a block that a wall compresses, plateau, energies, densification.

With the force F of a wall along its way d, the area A and the height h of the block before the test, stress is F/A and
strain d/h from the first contact on. Definitions are those of ISO 13314:2011 for porous metals:

- first peak: the first maximum of the stress that is followed by a drop; none where it is within half a window of the
  first contact, as the mean has no full window there;
- plateau stress: mean stress between 20 and 40 % of strain;
- end of the plateau: the strain at which the stress reaches 1.3 times the plateau stress;
- energy by volume: integral of the stress over the strain, up to 50 %, and up to densification;
- densification: the strain at which the efficiency, this integral over the largest stress so far, is largest (Q. M. Li,
  I. Magkiriadis, J. J. Harrigan, Journal of Cellular Plastics 42 (2006) 371-392).

All but energies are those of the mean stress over a window of strain, so that a peak of a single row is none. The
window is about the strain, and narrower near both ends of the curve, where it is that of the rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..output.result import impulse_of
from ..output.table import Table, select
from ..output.units import engineering
from ..registry import nearest
from .options import WINDOW

_PLATEAU = (0.2, 0.4)
_PLATEAU_END = 1.3
_ENERGY_TO = 0.5
_DROP = 0.02
"""Relative drop of the stress that makes a maximum the first peak."""


class CrushTest(NamedTuple):
    """A test, up to its largest compression.

    Attributes
    ----------
    strain : (n,) increasing, from the first contact
    stress : (n,) mean over the window [Pa]
    energy : (n,) integral of the stress over the strain [J/m3]
    efficiency : (n,) energy over the largest stress so far
    area, height, mass, window : [m2], [m], [kg], of strain
    """

    strain: np.ndarray
    stress: np.ndarray
    energy: np.ndarray
    efficiency: np.ndarray
    area: float
    height: float
    mass: float
    window: float

    def energy_to(self, strain: float) -> float:
        """Energy by volume up to a strain [J/m3], NaN beyond the test."""
        return float(np.interp(strain, self.strain, self.energy)) if strain <= self.strain[-1] else np.nan

    def table(self) -> Table:
        """The curves."""
        return Table(
            {
                "strain": self.strain,
                "stress": self.stress,
                "energy_by_volume": self.energy,
                "efficiency": self.efficiency,
            }
        )

    def figures(self) -> Table:
        """Names, values and units of the figures; values are NaN where the test does not reach them."""
        first, last = _PLATEAU
        plateau = (self.energy_to(last) - self.energy_to(first)) / (last - first)
        at = self._first_peak()
        peak = at is not None and self._has_window(at)
        ends = self._reaches(first, _PLATEAU_END * plateau)
        best = int(np.argmax(self.efficiency))
        dense = float(self.strain[best]) if best < len(self.strain) - 1 else np.nan
        volume = self.area * self.height
        half = self.energy_to(_ENERGY_TO)
        rows = [
            ("area", self.area, "m2"),
            ("height", self.height, "m"),
            ("mass", self.mass, "kg"),
            ("largest strain", float(self.strain[-1]), ""),
            ("largest stress", float(self.stress.max()), "Pa"),
            ("first peak", float(self.stress[at]) if peak else np.nan, "Pa"),
            ("strain at the first peak", float(self.strain[at]) if peak else np.nan, ""),
            ("plateau stress (20 to 40 %)", plateau, "Pa"),
            ("strain at the end of the plateau", ends, ""),
            ("densification strain", dense, ""),
            ("largest efficiency", float(self.efficiency[best]), ""),
            ("energy by volume to 50 %", half, "J/m³"),
            ("energy by mass to 50 %", half * volume / self.mass, "J/kg"),
            ("energy by volume to densification", self.energy_to(dense), "J/m³"),
            ("energy by mass to densification", self.energy_to(dense) * volume / self.mass, "J/kg"),
            ("energy of the test", float(self.energy[-1]) * volume, "J"),
            ("window of strain", self.window, ""),
        ]
        names, values, units = zip(*rows, strict=True)
        return Table({"figure": list(names), "value": np.array(values), "unit": list(units)})

    def texts(self) -> dict[str, str]:
        """The figures as texts by name."""
        found = {}
        for row in self.figures().rows:
            value, unit = row["value"], row["unit"]
            text = engineering(value, unit) if unit in ("Pa", "J", "J/m³", "J/kg") else f"{value:.6g} {unit}".rstrip()
            found[row["figure"]] = text if np.isfinite(value) else "none"
        return found

    def _reaches(self, first: float, stress: float) -> float:
        """Return the strain beyond ``first`` at which the stress [Pa] is reached, NaN without."""
        beyond = np.flatnonzero((self.strain > first) & (self.stress >= stress))
        if not len(beyond):
            return np.nan
        beside = slice(max(int(beyond[0]) - 1, 0), int(beyond[0]) + 1)
        return float(np.interp(stress, self.stress[beside], self.strain[beside]))

    def remarks(self) -> list[str]:
        """Return what users should know of the figures."""
        at = self._first_peak()
        if at is None or self._has_window(at):
            return []
        return [
            f"the first peak is within half a window of strain ({self.window:g}) of the first contact and has no mean "
            "over one: give a smaller window, 0 for the rows as they are"
        ]

    def _first_peak(self) -> int | None:
        """Return the number of the first maximum of stress that a drop follows, None without."""
        largest = np.maximum.accumulate(self.stress)
        dropped = np.flatnonzero(self.stress < (1.0 - _DROP) * largest)
        return int(np.argmax(self.stress[: dropped[0]])) if len(dropped) else None

    def _has_window(self, at: int) -> bool:
        """Return whether a full window of strain fits before and after a maximum."""
        return self.window == 0.0 or at > 0 and bool(self.strain[at - 1] >= 0.5 * self.window)


def crush(
    result_path: Path | str | Any,
    wall: str,
    *,
    area: float | None = None,
    height: float | None = None,
    displacement: str | None = None,
    window: float = WINDOW,
) -> CrushTest:
    """Return a crush test from a result.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    wall : name of the wall that compresses the block
    area, height : of the block across and along the way of the wall [m2], [m]; None: those of the box around the mesh
    displacement : component of the history whose change compresses the block, such as ``probe/top/position.z``, for
        walls that do not move; None: the way of the wall
    window : of strain, over which the stress is averaged; 0: none

    Raises
    ------
    InputError
        If there is no such wall or component, or the wall is not touched, or does not move.
    """
    from scipy.integrate import cumulative_trapezoid

    from .chart import opened

    for name, value in (("area", area), ("height", height)):
        if value is not None and not (value > 0.0 and np.isfinite(value)):
            raise InputError(f"crush: {name} = {value:g}: expected a number > 0")
    if not 0.0 <= window < 0.2:
        raise InputError(f"crush: window = {window:g}: expected a strain from 0 to 0.2")
    with opened(result_path) as result:
        case, names = result.case, [each.name for each in result.case.every_wall]
        if wall not in names or f"wall/{wall}/force" not in result.history:
            raise InputError(f"{result.path}: there is no wall {wall!r}{nearest(wall, names)}")
        way, along = _way(result, wall, displacement)
        force = np.abs(_mean_forces(result.history, wall) @ along)
        box = np.ptp(np.asarray(result.positions(0), dtype=float), axis=0)
    touched = np.flatnonzero(force > 0.0)
    if not len(touched):
        raise InputError(f"{result.path}: wall {wall!r} is not touched")
    start, end = max(int(touched[0]) - 1, 0), int(np.argmax(way)) + 1
    if end - start < 3:
        raise InputError(f"{result.path}: wall {wall!r} compresses nothing: its force begins where its way ends")
    axis = int(np.argmax(np.abs(along)))
    if (area is None or height is None) and abs(along[axis]) < 1.0 - 1e-9:
        raise InputError(f"crush: wall {wall!r} moves along no axis: give the area and the height of the block")
    area = float(np.prod(np.delete(box, axis))) if area is None else area
    height = float(box[axis]) if height is None else height
    if not area > 0.0 or not height > 0.0:
        raise InputError("crush: the box around the mesh has no volume: give the area and the height of the block")
    way, force = way[start:end].copy(), force[start:end]
    if force[0] == 0.0 and force[2] > force[1]:  # between two rows: where the line through the next two has no force
        touch = way[1] - force[1] * (way[2] - way[1]) / (force[2] - force[1])
        way[0] = min(max(touch, way[0]), way[1])
    # loading only: where the wall goes back, the way so far is kept
    strain = np.maximum.accumulate((way - way[0]) / height)
    kept = np.diff(strain, prepend=-1.0) > 0.0
    work = cumulative_trapezoid(force, strain, initial=0.0) / area
    strain, energy, stress = strain[kept], work[kept], force[kept] / area
    if window > 0.0:
        half = np.minimum(0.5 * window, np.minimum(strain, strain[-1] - strain))  # narrower towards both ends
        rise = np.interp(strain + half, strain, energy) - np.interp(strain - half, strain, energy)
        stress = np.where(half > 0.0, rise / np.where(half > 0.0, 2.0 * half, 1.0), stress)
    largest = np.maximum.accumulate(stress)
    efficiency = np.divide(energy, largest, out=np.zeros_like(energy), where=largest > 0.0)
    return CrushTest(strain, stress, energy, efficiency, area, height, _mass(case), window)


def _way(result: Any, wall: str, displacement: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the compression (rows,) [m] and the unit vector (3,) along which forces count."""
    history = result.history
    if displacement is not None:
        selected = select(history, displacement).reduced()
        values = selected.values
        if values.ndim != 1:
            raise InputError(f"crush: {displacement} has several components; name one, like {displacement}.z")
        if selected.unit not in ("m", None):
            raise InputError(f"crush: {displacement} is in {selected.unit or '1'}: expected a length in m")
        if not np.isfinite(values).all():
            raise InputError(f"crush: {displacement} is no number in {(~np.isfinite(values)).sum()} rows")
        force = np.asarray(history[f"wall/{wall}/force"]).sum(axis=0)
        size = float(np.linalg.norm(force))
        if size == 0.0:
            raise InputError(f"{result.path}: wall {wall!r} is not touched")
        return np.abs(values - values[0]), force / size
    places = np.asarray(history.get(f"wall/{wall}/position", np.zeros((1, 3))))
    moved = places - places[0]
    far = moved[int(np.argmax(np.linalg.norm(moved, axis=1)))]
    length = float(np.linalg.norm(far))
    if length == 0.0:
        raise InputError(
            f"crush: wall {wall!r} does not move: give the component whose change compresses the block, such as "
            "displacement = probe/top/position.z"
        )
    return moved @ (far / length), far / length


def _mean_forces(history: Any, wall: str) -> np.ndarray:
    """Return the force (rows, 3) [N] of a wall: its impulse over the time of a row where there is one."""
    force = np.asarray(history[f"wall/{wall}/force"], dtype=float)
    impulse = impulse_of(history, f"wall/{wall}/force")
    if impulse is None or len(force) < 2:
        return force
    time = np.asarray(history["time"], dtype=float)
    mean = np.diff(impulse, axis=0) / np.diff(time)[:, None]
    # at a row, the mean of the intervals beside it
    return np.vstack([mean[:1], 0.5 * (mean[1:] + mean[:-1]), mean[-1:]])


def _mass(case: Any) -> float:
    """Return the mass of the truss of a case [kg]."""
    from mpi4py import MPI

    from ..stepping.model import Model

    stages = case.stages
    return Model(stages[0], MPI.COMM_SELF, later=stages[1:]).total_mass


def draw_crush(test: CrushTest, file: Path | str, title: str = "") -> Path:
    """Draw stress, energy and efficiency over strain into a file; return it.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from matplotlib import rc_context

    from .chart import STYLE, Chart, Curve, Panel, largest

    file = Path(file)
    over = ("strain", "")
    figures = {row["figure"]: row["value"] for row in test.figures().rows}
    plateau, (first, last) = figures["plateau stress (20 to 40 %)"], _PLATEAU
    curves = [Curve("stress", test.stress, place=test.strain)]
    if np.isfinite(plateau):
        curves.append(Curve("plateau", np.full(2, plateau), place=np.array([first, last])))
    energy, efficiency = (
        [Curve(name, values, place=test.strain)]
        for name, values in (("energy", test.energy), ("efficiency", test.efficiency))
    )
    panels = [
        Panel("stress", "Pa", curves, over=over),
        Panel("energy by volume", "J/m³", energy, over=over, scale=(1e-6, "MJ/m³"), legend=False),
        Panel("efficiency", "", efficiency, over=over, legend=False),
    ]
    with rc_context(STYLE):
        chart = Chart(panels, title or "Crush test", test.strain)
        for axes, panel in zip(chart.axes, panels, strict=True):
            if min(curve.values.min() for curve in panel.curves) >= 0.0 < largest(panel.curves[0].values):
                axes.set_ylim(bottom=0.0)
        return chart.save(file.with_suffix(""), (file.suffix[1:] or "png",))[0]
