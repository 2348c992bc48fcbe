"""Supports along directions that are no axes exclude contact at their nodes.

Contact requires that supports prescribe components along axes: a free direction that is none would have to enter
projections, frames, friction and the treatments of impact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..parallel.agreement import agreed

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh
    from .contact import Contact
    from .links import Links

__all__ = ["refuse_inclined"]


def refuse_inclined(source: str, mesh: DistributedMesh, nodes: np.ndarray, contact: Contact, links: Links) -> None:
    """Refuse walls, contact pairs and constraints at owned nodes (m,) with such supports. Collective.

    Raises
    ------
    InputError
        On all ranks.
    """
    numbers = mesh.node_ids[nodes]
    with agreed(mesh.comm):
        what = "a [[support]] prescribes a direction that is not an axis at node"
        for k, name in enumerate(contact.names):
            both = numbers[contact.members[nodes, k]]
            if len(both):
                raise InputError(
                    f"{source}: wall {name!r}: {what} {both.min()}, which the wall could also stop: contact "
                    "requires supports along axes; give the wall a node_set without such nodes"
                )
        for link in links:
            both = np.intersect1d(numbers, link.numbers)
            if len(both):
                raise InputError(
                    f"{source}: contact_pair, constraint: {what} {both[0]}, which is part of one: these require "
                    "supports along axes"
                )
