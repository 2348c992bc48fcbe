"""Checks before the first step that contact pairs are compatible with the rest of a case."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..tolerances import ON_BOUND

if TYPE_CHECKING:
    from .pairs import ContactPairs

__all__ = ["check_scheme", "check_start"]


def check_scheme(pairs: ContactPairs, on_its_own: bool, treatment: str) -> None:
    """Refuse schemes, treatments of impact and walls that are not compatible with the pairs of a case. Collective.

    Parameters
    ----------
    pairs : ContactPairs
    on_its_own : bool
        Whether nodes are solved independently, by an explicit scheme with lumped mass.
    treatment : str
        Treatment of impact, ``contact.treatment`` of the case.

    Raises
    ------
    InputError
        On all ranks.
    """
    key, coupled = f"{pairs.source}: contact_pair", pairs.coupled
    if coupled.shared_node is not None and not on_its_own:
        raise InputError(
            f"{key}: node {coupled.shared_node} is in several pairs, which needs an explicit "
            "integrator with lumped mass"
        )
    if coupled.any and treatment != "scheme":
        raise InputError(
            f"{key}: node {coupled.coupled_node} is in several pairs, or a wall stops it as well, which needs "
            'contact.treatment = "scheme"'
        )
    walls = coupled.contact
    met = walls.members[pairs.local[pairs.mine]].any(axis=0).astype(np.int64)
    pairs.mesh.comm.Allreduce(MPI.IN_PLACE, met)
    refused = walls.special & (met > 0)
    if refused.any():
        name = walls.names[int(np.argmax(refused))]
        raise InputError(
            f"{key}: wall {name!r} stops nodes of pairs: such a wall must be flat, without mass, friction and "
            "restitution, and not tied; or give it a node_set without them"
        )


def check_start(pairs: ContactPairs, x: np.ndarray, length: float, source: str) -> None:
    """Refuse pairs whose nodes start beyond each other by more than rounding of the model's size. Collective.

    Parameters
    ----------
    pairs : ContactPairs
    x : (owned, 3) positions at the start [m]
    length : size of the model [m]
    source : name of the case file, for messages

    Raises
    ------
    InputError
        On all ranks; names the two nodes and their overlap.
    """
    distance = pairs.distances(pairs.gather(x)) - pairs.gaps
    pair = int(np.argmin(distance)) if len(distance) else -1
    deepest = (np.inf,) if pair < 0 else (float(distance[pair]), int(pairs.table[pair]), *pairs.numbers(pair))
    deepest = min(pairs.mesh.comm.allgather(deepest))
    if deepest[0] < -ON_BOUND * length:
        distance, table, second, first = deepest
        raise InputError(
            f"{source}: contact_pair {pairs.names[table]!r}: nodes {first} and "
            f"{second} start {-distance:.6g} m beyond each other; reverse the direction, which "
            "points from the first to the second, or move the mesh"
        )
