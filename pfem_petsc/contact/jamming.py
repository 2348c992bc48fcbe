"""Jamming by friction: Coulomb's law may have no solution if a wall must push a node that supports guide.

A node with prescribed components moves in the remaining directions, along the free part f of a wall's normal,
|f|^2 = a. The wall pushes it along f with a lambda, and friction resists this motion with mu lambda sqrt(a (1 - a)). If
mu >= sqrt(a/(1 - a)), the cotangent of the angle between guide and normal, no normal force can move the node: the wedge
is self-locking.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..tolerances import FREE_PART
from .free_parts import free_squares

if TYPE_CHECKING:
    from .contact import Contact

__all__ = ["jam"]


def jam(contact: Contact, node: int, normals: np.ndarray) -> str:
    """Return why the friction of an owned node has no solution, and the remedy; empty if the node is not jammed.

    Parameters
    ----------
    contact : Contact
    normals : (w, 3) of the walls at the node
    """
    fixed = contact.fixed[node]
    if not fixed.any():
        return ""
    square = free_squares(fixed, normals)
    least = np.sqrt(square / np.maximum(1.0 - square, 1e-300))
    jams = contact.members[node] & (square > FREE_PART) & (contact.static_friction >= least)
    if not jams.any():
        return ""
    wall = int(np.flatnonzero(jams)[0])
    return (
        f"friction jams node {contact.mesh.node_ids[node]}: its supports let it move only at an angle at which wall "
        f"{contact.names[wall]!r} cannot push it if the coefficient of friction is {least[wall]:.3g} or more, and it "
        f"is {contact.static_friction[wall]:.3g}; reduce the friction, free the node, or name the nodes that the wall "
        "stops with 'node_set'"
    )
