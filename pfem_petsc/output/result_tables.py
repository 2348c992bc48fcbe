"""What a result has besides snapshots: the columns of its history, and its modes; read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..registry import nearest
from .modes import MODES, NAMES
from .units import Axis

if TYPE_CHECKING:
    from .result import Result

__all__ = ["History", "Modes"]


class History(Mapping[str, np.ndarray]):
    """Columns of the history by name, one row per recorded step: ``history["kinetic_energy"]``.

    Names with slashes can be accessed by parts: ``history["wall"]["floor"]["force"]`` or ``history.wall.floor.force``.
    """

    def __init__(self, result: Result, columns: list[str], n_rows: int, prefix: str = "") -> None:
        self.n_rows = n_rows
        self._result, self._columns, self._prefix = result, columns, prefix
        self._names = [name.removeprefix(prefix) for name in columns if name.startswith(prefix)]

    @property
    def axis(self) -> Axis:
        """What the times of its rows are."""
        return self._result.axis

    def __getitem__(self, name: str) -> Any:
        if name in self._names:
            return self._result.column(self._prefix + name, self.n_rows)
        if any(known.startswith(f"{name}/") for known in self._names):
            return History(self._result, self._columns, self.n_rows, f"{self._prefix}{name}/")
        raise KeyError(f"{self._result.path}: history has no {self._prefix}{name}{nearest(name, self._names)}")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(str(error)) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Modes:
    """Natural vibrations or buckling modes, the lowest first; read when asked for.

    Attributes
    ----------
    kind : "vibration" or "buckling"
    """

    def __init__(self, result: Result, names: list[str]) -> None:
        self._result, self._kept = result, names
        self.kind = next(kind for kind, (name, _) in NAMES.items() if name in names)

    def __len__(self) -> int:
        return self._result.n_modes

    @property
    def frequency(self) -> np.ndarray:
        """(modes,) [Hz]; negative where the state is unstable: minus the growth rate over 2 pi."""
        return self._read("frequency")

    @property
    def load_factor(self) -> np.ndarray:
        """(modes,) factors of the state's axial forces at which the truss buckles."""
        return self._read("load_factor")

    @property
    def eigenvalue(self) -> np.ndarray:
        """(modes,) squared circular frequencies [1/s2], or load factors."""
        return self._read("eigenvalue")

    @property
    def values(self) -> np.ndarray:
        """(modes,) :attr:`frequency` or :attr:`load_factor`."""
        return self._read(NAMES[self.kind][0])

    @property
    def shape(self) -> np.ndarray:
        """(modes, nodes, 3): with x^T M x = 1 [kg^-1/2], of buckling with a largest component of 1."""
        return self._read("shape")

    def label(self, k: int) -> str:
        """Text of mode k, from 0: ``"mode 3: 149.4 Hz"``."""
        name, unit = NAMES[self.kind]
        text = f"{self.values[k]:.6g} {unit}".rstrip()
        return f"mode {k + 1}: {text}" if unit else f"mode {k + 1}: {name.replace('_', ' ')} {text}"

    def _read(self, name: str) -> np.ndarray:
        if name not in self._kept:
            raise InputError(f"{self._result.path}: modes of {self.kind} have no {name}{nearest(name, self._kept)}")
        return self._result.read(f"{MODES}/{name}", slice(0, self._result.n_modes))
