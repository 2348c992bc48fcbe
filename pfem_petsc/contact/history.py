"""Contact in the history: columns, the contributions of a rank to their sums, and the values of a row."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..output.sums import WALL
from .contact import Contact
from .forces import WallForces

if TYPE_CHECKING:
    from ..stepping.impulses import Impulses

__all__ = ["ContactColumns", "contact_columns"]

_COUNTS = ("contacts", "releases")
_WALL = [(name, (3,) if size == 3 else (), np.int64 if name in _COUNTS else float) for name, size in WALL.sizes.items()]


def contact_columns(contact: Contact) -> list[tuple[str, tuple[int, ...], type]]:
    """Return name, shape and type of the columns of a case's walls."""
    columns: list[tuple[str, tuple[int, ...], type]] = [("active_set_changes", (), np.int64)] if contact.any else []
    for k, name in enumerate(contact.names):
        columns += [(f"wall/{name}/{what}", shape, kind) for what, shape, kind in _WALL]
        if contact.moving[k]:
            columns += [(f"wall/{name}/{what}", (3,), float) for what in ("position", "velocity")]
    return columns


class ContactColumns:
    """Converts sums over ranks to the columns of :func:`contact_columns`, in their order.

    Attributes
    ----------
    size : length of a rank's contribution: the number of changes of the active set, and the ``WALL`` of
        :mod:`~pfem_petsc.output.sums` for each wall
    width : number of values in the columns
    """

    def __init__(self, contact: Contact) -> None:
        self.contact = contact
        walls = len(contact.names)
        self.size = 1 + WALL.width * walls if contact.any else 0
        starts = 1 + np.cumsum([0, *(WALL.width + 6 * contact.moving)]).astype(np.int64)
        self.width = int(starts[-1]) if contact.any else 0
        self._at = starts[:-1, None] + np.arange(WALL.width)
        self._moving = np.flatnonzero(contact.moving)
        self._motion_at = starts[self._moving, None] + np.arange(WALL.width, WALL.width + 6)

    def fill(self, sums: np.ndarray, walls: WallForces, impulses: Impulses) -> None:
        """Write this rank's contribution into ``sums`` (size,)."""
        log = self.contact.log
        sums[0] = log.changes
        share = sums[1:].reshape(-1, WALL.width)
        share[:, WALL["force"]] = walls.force
        share[:, WALL["moment"]] = walls.moment
        share[:, WALL.first("contacts")] = walls.contacts
        share[:, WALL.first("releases")] = log.releases
        impulses.fill_walls(share)

    def contacts(self, sums: np.ndarray) -> np.ndarray | None:
        """Return the number of nodes that touch each wall (walls,) from the sums over ranks; None without walls."""
        return sums[1 : self.size].reshape(-1, WALL.width)[:, WALL.first("contacts")] if self.size else None

    def put(self, sums: np.ndarray, time: float, values: np.ndarray) -> None:
        """Write the columns ``values`` (width,) at a time [s] from the sums over ranks, and reset the count of
        changes."""
        contact = self.contact
        total = sums[1:].reshape(-1, WALL.width)
        total[:, WALL.first("contact_time")] = contact.log.time
        values[0] = sums[0]
        values[self._at] = total
        if len(self._moving):
            motion = np.hstack([contact.positions(time), contact.motion.rates(time)])
            values[self._motion_at] = motion[self._moving]
        contact.log.changes = 0
