"""A bound on the distance of two nodes: a rope that is slack or taut, or a strut that only pushes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pfem_petsc.case.base import PositiveFloat
from pfem_petsc.contact.constraints.base import Constraint as Base
from pfem_petsc.contact.constraints.base import ConstraintKeys, NodeSetName, NodesOf
from pfem_petsc.errors import InputError

__all__ = ["Constraint", "Parameters"]


class Parameters(ConstraintKeys):
    """Keys of a tether."""

    first: NodeSetName
    """Name of a node set."""
    second: NodeSetName
    """Name of a node set of as many nodes; they are joined in the order of their numbers."""
    length: PositiveFloat
    """Length [m]."""
    bound: Literal["at_most", "at_least"] = "at_most"
    """What the length is to the distance."""


class Constraint(Base):
    """One row for each two nodes: +-(distance - length)."""

    def __init__(self, parameters: Parameters, nodes_of: NodesOf) -> None:
        first, second = nodes_of(parameters.first), nodes_of(parameters.second)
        if first.count != second.count:
            raise InputError(f"first has {first.count} nodes and second {second.count}: name as many")
        self.nodes = np.stack([first.numbers, second.numbers], axis=1)
        self.length = parameters.length
        self.sign = 1.0 if parameters.bound == "at_least" else -1.0

    def values(self, x: np.ndarray) -> np.ndarray:
        return self.sign * (np.linalg.norm(x[:, 1] - x[:, 0], axis=1) - self.length)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        arm = x[:, 1] - x[:, 0]
        along = self.sign * arm / np.maximum(np.linalg.norm(arm, axis=1), 1e-300)[:, None]
        return np.stack([-along, along], axis=1)

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        # of the distance d: the square of the velocity across it over d
        arm, apart = x[:, 1] - x[:, 0], v[:, 1] - v[:, 0]
        distance = np.linalg.norm(arm, axis=1)
        across = np.cross(arm, apart) / np.maximum(distance, 1e-300)[:, None]
        return self.sign * (across**2).sum(axis=1) / np.maximum(distance, 1e-300)
