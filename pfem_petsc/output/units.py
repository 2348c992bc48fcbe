"""Units of fields and history columns, and numbers with SI prefixes, shared by log, curves and pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple

from ..columns import FIELDS, declared
from ..errors import InputError
from ..mechanics.materials.base import LAWS
from ..registry import modules

__all__ = [
    "AXES",
    "LOAD_FACTOR",
    "POINT",
    "PREFIXES",
    "TIME",
    "Axis",
    "common_prefix",
    "dimensions",
    "duration",
    "engineering",
    "field_unit",
    "powers_of",
    "prefix_for",
    "product",
    "simplest",
    "text_of",
    "unit_of",
]

_LEAST = {"Pa": 0, "Hz": 0, "N": -6, "J": -9, "W": -9, "m/s": -6, "m/s²": -3}
"""Powers of the smallest prefixes in use: no one thinks in millipascal, and a picojoule is mostly rounding."""

PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


class Axis(NamedTuple):
    """What the times of results are: how a place on it is told, and the key that ends it.

    Attributes
    ----------
    symbol, unit : of a place on the axis, ``t = 1.000 s``; the unit is empty for pure numbers
    key : of the case file that says where it ends
    start : where places are counted from, as load factors are from the start of their stage
    staged : whether it has static stages, whose load factors are added to the times of the others
    """

    symbol: str
    unit: str
    key: str
    start: float = 0.0
    staged: bool = False

    def place(self, value: float, digits: int = 4) -> str:
        """Text of a place."""
        value = value - self.start
        return f"{self.symbol} = {engineering(value, self.unit, digits)}" if self.unit else f"{self.symbol} {value:.6g}"

    def scale(self, largest: float) -> tuple[float, str]:
        """Return factor and unit of numbers up to the largest; those that are load factors too have no prefix."""
        return (1.0, self.unit) if self.staged else prefix_for(largest, self.unit)

    def span(self, first: float, last: float) -> str:
        """Text of a part of the axis."""
        if self.staged:
            return f"{first:.6g} to {last:.6g} ({self.label(self.unit)})"
        if self.unit:
            return f"{engineering(first, self.unit)} to {engineering(last, self.unit)}"
        return f"{self.symbol} {first:.6g} to {last:.6g}"

    def label(self, unit: str) -> str:
        """Label of an axis whose numbers are in a unit that :meth:`scale` gave."""
        label = f"{'time' if self.symbol == 't' else self.symbol} [{unit}]" if unit else self.symbol
        return f"{label}, in static stages load factor" if self.staged else label

    def exact(self, value: float) -> str:
        """The same as :meth:`place` with a plain number, for messages."""
        value = value - self.start
        return f"{self.symbol} = {value:.6g} {self.unit}" if self.unit else f"{self.symbol} {value:.6g}"


TIME = Axis("t", "s", "time.end")
LOAD_FACTOR = Axis("load factor", "", "static.end")
POINT = Axis("point", "", "static.max_points")
MODE = Axis("mode", "", "modes.count")
AXES = {axis.symbol: axis for axis in (TIME, LOAD_FACTOR, POINT, MODE)}


def unit_of(name: str) -> str:
    """Return the SI unit of a history column (``"wall/floor/force"`` -> ``"N"``); empty for pure numbers."""
    return declared(name).unit


def field_unit(name: str) -> str:
    """Return the SI unit of a field, or of an internal variable of a material law; empty for pure numbers."""
    units = {field.name: field.unit for field in FIELDS}
    return units[name] if name in units else _units_of_variables().get(name, "")


@cache
def _units_of_variables() -> dict[str, str]:
    return dict(variable for law in modules(LAWS).values() for variable in law.LAW.internal)


_ATOMS = ("m", "s", "kg", "N", "Pa", "J", "K", "Hz", "W", "rad", "1")
_SUPERSCRIPTS = {2: "²", 3: "³"}
_DERIVED: dict[str, dict[str, int]] = {
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "Hz": {"s": -1},
}
_USUAL: tuple[dict[str, int], ...] = ({}, {"m": 1, "s": -1}, {"m": 1, "s": -2})
"""Products that are shown as such although others are as short: m/s² and not N/kg."""


def powers_of(unit: str) -> dict[str, int]:
    """Return the units that one is a product of, and their powers: ``"kg m²/s"`` -> {kg: 1, m: 2, s: -1}.

    Powers may also be written ``m2`` or ``m^2``.

    Raises
    ------
    InputError
        For a unit that is not known here.
    """
    powers: dict[str, int] = {}
    for number, part in enumerate(unit.split("/")):
        for word in part.replace("(", " ").replace(")", " ").replace("*", " ").replace("·", " ").split():
            found = re.fullmatch(r"([A-Za-z]+|1)\^?(-?\d+|[²³])?", word)
            if found is None or found[1] not in _ATOMS:
                raise InputError(f"[{unit}]: {word!r} is not a unit; units are SI: {', '.join(_ATOMS)} and powers, m2")
            power = {"²": 2, "³": 3}.get(found[2] or "1") or int(found[2] or 1)
            power = -power if number else power
            powers[found[1]] = powers.get(found[1], 0) + power
    return {atom: power for atom, power in powers.items() if power and atom != "1"}


def product(*factors: tuple[Mapping[str, int], int]) -> dict[str, int]:
    """Return the powers of a product of units, each with a power."""
    powers: dict[str, int] = {}
    for factor, power in factors:
        for atom, of in factor.items():
            powers[atom] = powers.get(atom, 0) + power * of
    return {atom: power for atom, power in powers.items() if power}


def dimensions(powers: Mapping[str, int]) -> dict[str, int]:
    """Return the powers of kg, m, s, K and rad that those of a unit are: N/kg and m/s² have the same."""
    return product(*((_DERIVED.get(atom, {atom: 1}), power) for atom, power in powers.items()))


def simplest(powers: Mapping[str, int]) -> str:
    """Return the text of the simplest unit of the same dimensions: ``N s²/(kg m)`` -> none, ``J/m`` -> ``N``.

    That is a single unit, else one of the usual products, else what has the least powers of these: the unit itself, and
    base units with at most one of N, J, Pa, W. Products of base units only stay as they are.
    """
    base = dimensions(powers)
    single = [{name: 1} for name in _DERIVED if name != "Hz"]
    usual = next((unit for unit in (*single, *_USUAL) if dimensions(unit) == base), None)
    if usual is not None or not set(powers) & set(_DERIVED):
        return text_of(powers if usual is None else usual)
    others = [product((base, 1), (dimensions(unit), -1), (unit, 1)) for unit in single]
    return text_of(min(powers, base, *others, key=lambda unit: sum(map(abs, unit.values()))))


def text_of(powers: Mapping[str, int]) -> str:
    """Return the text of a unit from its powers, as of :func:`powers_of`; empty for a pure number."""

    def side(sign: int) -> list[str]:
        sizes = {atom: sign * power for atom, power in powers.items() if sign * power > 0}
        return [atom + ("" if n == 1 else _SUPERSCRIPTS.get(n, f"^{n}")) for atom, n in sizes.items()]

    above, below = side(1), side(-1)
    divided = f"({' '.join(below)})" if len(below) > 1 else "".join(below)
    return f"{' '.join(above) or '1'}/{divided}" if below else " ".join(above)


def prefix_for(magnitude: float, unit: str) -> tuple[float, str]:
    """Return factor and unit that scale a magnitude to 1 .. 1000: ``(0.0024, "s")`` -> ``(1e3, "ms")``.

    Powers (``m²``), temperatures and pure numbers keep their unit, because a prefix would be misread; so do zero,
    values that are not finite, and values too small for a prefix in use (``0.5 Pa``, ``2e-13 J``). Kilograms already
    have a prefix.
    """
    plain = unit in ("s", "m", "m/s", "m/s²", "N", "Pa", "J", "W", "Hz", "B")
    if not plain or not math.isfinite(magnitude) or magnitude == 0.0:
        return 1.0, unit
    # with a small tolerance, so that 999.9999999 ms is shown as 1 s
    power = 3 * math.floor(math.log10(abs(magnitude) * (1 + 1e-9)) / 3)
    if unit in ("m/s", "m/s²", "m") and power > 0:
        power = min(power, 3) if unit != "m/s²" else 0
    power = max(-12, min(12, power))
    power = power if power >= _LEAST.get(unit, -12) else 0
    return 10.0**-power, PREFIXES[power] + unit


def common_prefix(magnitudes: Iterable[float], unit: str) -> tuple[float, str]:
    """Return one factor and unit for several panels: those of the largest, or of one between that and the smallest.

    The latter where the smallest panel would have numbers below 0.01. Panels of rounding errors do not count.

    Parameters
    ----------
    magnitudes : the largest number of each panel, in the unit
    unit : as for :func:`prefix_for`
    """
    sizes = [abs(size) for size in magnitudes if math.isfinite(size) and size != 0.0]
    sizes = [size for size in sizes if size > 1e-9 * max(sizes)]
    factor, shown = prefix_for(max(sizes, default=0.0), unit)
    if not sizes or factor * min(sizes) >= 0.01:
        return factor, shown
    most, least = (round(-math.log10(prefix_for(size, unit)[0])) for size in (max(sizes), min(sizes)))
    power = least + 3 * ((most - least) // 6)
    return (10.0**-power, PREFIXES[power] + unit) if most > least else (factor, shown)


def engineering(value: float, unit: str, digits: int = 4) -> str:
    """Return the text of a value with a suitable prefix: ``engineering(2.4e-6, "s")`` -> ``"2.400 µs"``."""
    factor, name = prefix_for(value, unit)
    scaled = value * factor
    if scaled == 0.0 or not math.isfinite(scaled):
        return f"{scaled:.0f} {name}".rstrip()
    decimals = digits - 1 - math.floor(math.log10(abs(scaled)) + 1e-12)
    if not 0 <= decimals <= digits + 2:
        return f"{scaled:.{digits - 1}e} {name}".rstrip()
    return f"{scaled:.{decimals}f} {name}".rstrip()


def duration(seconds: float) -> str:
    """Return the text of a wall time: ``"0.42 s"``, ``"12.3 s"``, ``"3:07"``, ``"2:05:41"``."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
