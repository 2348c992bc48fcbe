"""Layout of the sums of a history row, by names that compiled loops and Python share.

A rank's share of a row is a vector: :data:`HEAD`, then for cases with walls the changes of the active set and one
:data:`WALL` per wall, one :data:`PAIR` per table of contact pairs, and the probes. Loops use the positions as integers
at module level, which are constants of the machine code.
"""

from __future__ import annotations

from collections.abc import Iterable

from ..energies import ENERGIES

__all__ = ["HEAD", "PAIR", "WALL", "Places"]


class Places:
    """Positions of consecutive named numbers and vectors.

    Attributes
    ----------
    sizes : name to its number of components
    width : total number of components
    """

    def __init__(self, sizes: Iterable[tuple[str, int]]) -> None:
        self.sizes = dict(sizes)
        self._first: dict[str, int] = {}
        self.width = 0
        for name, size in self.sizes.items():
            self._first[name] = self.width
            self.width += size

    def __getitem__(self, name: str) -> slice:
        """The slice of a name."""
        first = self._first[name]
        return slice(first, first + self.sizes[name])

    def first(self, name: str) -> int:
        """Return the position of the first component of a name, the only one of a scalar."""
        return self._first[name]


_VECTORS = ("momentum", "angular_momentum", "centre_of_mass", "support_force")
_IMPULSES = ("external_impulse", "support_impulse", "damping_impulse")

HEAD = Places(
    [
        *((energy.name, 1) for energy in ENERGIES if energy.source != "derived"),
        *((name, 3) for name in (*_VECTORS, *_IMPULSES)),
        ("active_contacts", 1),
        ("slack_bars", 1),
        ("broken_bars", 1),
        ("alarm", 1),
    ]
)
"""Sums of all cases; ``centre_of_mass`` holds the sum of mass times position. ``slack_bars`` is a column of the history
for cases with laws whose bars can be slack."""

WALL = Places(
    [
        ("force", 3),
        ("moment", 3),
        ("impulse", 3),
        ("jump_impulse", 3),
        ("contacts", 1),
        ("contact_time", 1),
        ("releases", 1),
    ]
)

PAIR = Places([("force", 3), ("impulse", 3), ("jump_impulse", 3)])
