"""Creates the links of a case, which couple nodes to nodes. The only module that knows all kinds of links."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .constraint_link import ConstraintLink
from .links import Link, Links
from .pair_link import PairLink
from .pairs import ContactPairs

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .contact import Contact

__all__ = ["make_links"]


def make_links(
    case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh, fixed: np.ndarray, contact: Contact
) -> tuple[Links, ContactPairs | None]:
    """Create all links in the order in which a step treats them; also return the contact pairs. Collective.

    Parameters
    ----------
    case : Case
    nodes : owned local indices of each node set
    mesh : Mesh
    fixed : (owned, 3) bool, prescribed components
    contact : Contact

    Raises
    ------
    InputError
        On all ranks, for nodes that cannot be paired, or a constraint with invalid keys.
    """
    links: list[Link] = []
    pairs = None
    if case.contact_pair:
        pairs = ContactPairs(case, nodes, mesh, fixed, contact)
        links.append(PairLink(pairs))
    if case.constraint:
        links.append(ConstraintLink(case, nodes, mesh, fixed, contact))
    return Links(links), pairs
