"""What the parts of a simulation hold in memory: their arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

__all__ = ["held_by_parts"]

PARTS = {
    "mesh": ("mesh",),
    "state": ("state",),
    "bars": ("model.bars",),
    "model": ("model",),
    "stepper": ("stepper",),
    "output": ("outputs",),
}
"""Part to the objects of a simulation that make it up; an array that several hold belongs to the first part."""

_OWN = "pfem_petsc"


def held_by_parts(simulation: Any) -> dict[str, float]:
    """Return part to the bytes of its arrays on this rank; those of PETSc are not among them."""
    seen: set[int] = set()
    found = {}
    for part, paths in PARTS.items():
        objects = []
        for path in paths:
            held = simulation
            for name in path.split("."):
                held = getattr(held, name, None)
            objects.append(held)
        found[part] = float(sum(array.nbytes for array in _arrays(objects, seen)))
    return found


def _arrays(objects: Iterable[Any], seen: set[int]) -> Iterator[np.ndarray]:
    """Yield each array with memory of its own that objects hold, directly or through others, unless it was seen."""
    waiting = list(objects)
    while waiting:
        held = waiting.pop()
        if isinstance(held, np.ndarray):
            while isinstance(held.base, np.ndarray):
                held = held.base
            if id(held) not in seen and held.base is None:
                seen.add(id(held))
                yield held
            continue
        if id(held) in seen:
            continue
        seen.add(id(held))
        if isinstance(held, dict):
            waiting += held.values()
        elif isinstance(held, list | tuple | set):
            waiting += held
        elif type(held).__module__.startswith(_OWN) and not isinstance(held, type):
            waiting += vars(held).values() if hasattr(held, "__dict__") else ()
