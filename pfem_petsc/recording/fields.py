"""The fields of a snapshot: which ones a case wants, and their values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..case.settings import CELL_FIELDS, POINT_FIELDS

__all__ = ["CELL_FIELDS", "POINT_FIELDS", "Fields"]


class Fields:
    """Fields of the nodes and bars of this rank.

    Attributes
    ----------
    points, cells : names of the fields that the case asks for; by default all, temperatures where there are any
    """

    def __init__(self, model) -> None:
        self.model = model
        wanted, heated = model.case.output.fields, model.temperatures.any
        self.points = [name for name in POINT_FIELDS if wanted is None or name in wanted]
        self.cells = [
            name for name in CELL_FIELDS if (name in wanted if wanted is not None else name != "temperature" or heated)
        ]

    def at_nodes(self, state, acceleration: Callable[[], np.ndarray]) -> dict[str, np.ndarray]:
        """Name to (owned, 3). Collective where ``acceleration`` is."""
        owned = self.model.mesh.n_owned
        values = {
            "displacement": lambda: state.position - self.model.mesh.points[:owned],
            "velocity": lambda: state.v,
            "acceleration": acceleration,
            "contact_force": lambda: state.contact,
        }
        return {name: values[name]() for name in self.points}

    def at_bars(self, state) -> dict[str, np.ndarray]:
        """Name to (local bars,)."""
        if not self.cells:
            return {}
        bars = self.model.bars.fields(state.x)
        if "temperature" in self.cells:
            temperatures = self.model.temperatures
            bars["temperature"] = temperatures.values if temperatures.any else 0.0 * bars["strain"]
        return {name: bars[name] for name in self.cells}
