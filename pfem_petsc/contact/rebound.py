"""Restitution of explicit schemes: how fast a node leaves a wall that it has met within a step.

An explicit scheme gives a node one force a step, whatever the way that a wall leaves it. What such steps conserve is
m v-1/2 v+1/2 /2 and the energy of the bars between two positions, with velocities that are ways per step. A node that
would move by ``a`` towards a wall in a step, of which the forces at its start make ``p`` = h^2 F0/m, reaches the wall
after ``d`` and stays on it to the end of the step. The forces there pull it by ``q`` = h^2 F1/m towards the wall in the
next step, and it moves off by ``w``. Both impulses of the wall, at the ends of its way, do the work

    W = m/(2 h^2) [w^2 + q w - a^2 + p (a - d) - q d]
      = m/(2 h^2) [(w + q/2)^2 - I^2],    I^2 = a^2 - p (a - d) + q d + q^2/4.

I/h is the speed of the impact: w + q/2 = e I takes (1 - e^2) of its energy, and nothing at e = 1. Under a constant
force it is the exact one, v^2 + 2 F/m times the distance. With e a, or with a speed of another time, the node would be
given the work of forces on the way beyond the wall, which the bars have not lost.
"""

from __future__ import annotations

import numpy as np

__all__ = ["impact_square", "rebound_way"]


def impact_square(approach: np.ndarray, arrival: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """What of I^2 [m2] is known in the step of the impact, zero for nodes that are not on their way to the wall.

    Parameters
    ----------
    approach : a, way towards the wall without it [m]
    arrival : d, way to the wall [m]
    pull : p, what forces have made of the approach [m]
    """
    square = approach * approach - pull * (approach - arrival)
    return np.where(approach > 0.0, np.maximum(square, 0.0), 0.0)


def rebound_way(
    restitution: np.ndarray | float, square: np.ndarray, arrival: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """w + q/2, the speed of the rebound times the step [m]; 0 where ``square`` is.

    Parameters
    ----------
    restitution : e
    square, arrival : of the step of the impact, see :func:`impact_square`
    pull : q, towards the wall, of the forces where the node meets it [m]
    """
    whole = np.maximum(square + pull * arrival + 0.25 * pull * pull, 0.0)
    return np.where(square > 0.0, restitution * np.sqrt(whole), 0.0)
