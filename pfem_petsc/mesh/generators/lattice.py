"""A block of a space lattice: built-in or own unit cells, graded, curved, or cut to a closed surface."""

from __future__ import annotations

from ..lattices.build import generate, generate_on
from ..lattices.keys import Parameters

__all__ = ["Parameters", "generate", "generate_on"]
