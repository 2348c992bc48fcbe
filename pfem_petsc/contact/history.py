"""Contact in the history: columns, what a rank adds to their sums, and the values of a row."""

from __future__ import annotations

from typing import Any

import numpy as np

from .contact import Contact
from .forces import WallForces

__all__ = ["contact_columns", "contact_sums", "contact_values"]


def contact_columns(contact: Contact) -> list[tuple[str, tuple[int, ...], type]]:
    """Name, shape and type of the columns of a case's walls."""
    columns: list[tuple[str, tuple[int, ...], type]] = [("active_set_changes", (), np.int64)] if contact.any else []
    for k, name in enumerate(contact.names):
        columns += [
            (f"wall/{name}/force", (3,), float),
            (f"wall/{name}/moment", (3,), float),
            (f"wall/{name}/impulse", (3,), float),
            (f"wall/{name}/contacts", (), np.int64),
            (f"wall/{name}/contact_time", (), float),
            (f"wall/{name}/releases", (), np.int64),
        ]
        if contact.moving[k]:
            columns += [(f"wall/{name}/{what}", (3,), float) for what in ("position", "velocity")]
    return columns


def contact_sums(contact: Contact, walls: WallForces) -> np.ndarray:
    """What this rank adds to a row."""
    log = contact.log
    vectors = np.stack([walls.force, walls.moment, log.impulse], axis=1).ravel()
    return np.concatenate([vectors, walls.contacts, log.releases, [float(log.changes)]])


def contact_values(contact: Contact, sums: np.ndarray, at: int, time: float) -> tuple[dict[str, Any], int]:
    """Values of the columns from the sums over the ranks, which start at ``at``; and where what follows starts.

    The count of changes starts anew.
    """
    n = len(contact.names)
    vectors = sums[at : at + 9 * n].reshape(n, 3, 3)
    contacts, releases = sums[at + 9 * n : at + 11 * n].reshape(2, n)
    values: dict[str, Any] = {}
    if contact.any:
        values["active_set_changes"] = round(sums[at + 11 * n])
        positions, rates = contact.positions(time), contact.motion.rates(time)
    for k, name in enumerate(contact.names):
        for i, column in enumerate(("force", "moment", "impulse")):
            values[f"wall/{name}/{column}"] = vectors[k, i]
        values[f"wall/{name}/contacts"] = round(contacts[k])
        values[f"wall/{name}/contact_time"] = contact.log.time[k]
        values[f"wall/{name}/releases"] = round(releases[k])
        if contact.moving[k]:
            values[f"wall/{name}/position"] = positions[k]
            values[f"wall/{name}/velocity"] = rates[k]
    contact.log.changes = 0
    return values, at + 11 * n + 1
