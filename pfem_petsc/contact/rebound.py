"""Restitution for explicit schemes: the velocity at which a node leaves a wall that it hits within a step.

An explicit scheme evaluates one force per step, whatever part of the step's displacement a wall prevents. Such steps
conserve m v-1/2 v+1/2 /2 plus the energy of the bars between two positions, with velocities equal to displacements per
step. Suppose that a node would move by ``a`` towards a wall in a step, of which the forces at its start contribute
``p`` = h^2 F0/m. It reaches the wall after ``d`` and stays on it to the end of the step. The forces there pull it by
``q`` = h^2 F1/m towards the wall in the next step, and it moves off by ``w``. The two impulses of the wall do the work

    W = m/(2 h^2) [w^2 + q w - a^2 + p (a - d) - q d]
      = m/(2 h^2) [(w + q/2)^2 - I^2],    I^2 = a^2 - p (a - d) + q d + q^2/4.

I/h is the impact velocity: w + q/2 = e I dissipates (1 - e^2) of its energy, and nothing at e = 1. Under a constant
force it is exact, (I/h)^2 = v^2 + 2 F/m times the distance. With e a, or with a velocity at another time, the node
would receive work of the forces beyond the wall, which the bars have not lost.
"""

from __future__ import annotations

import numpy as np

__all__ = ["impact_square", "rebound_way"]


def impact_square(approach: np.ndarray, arrival: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Return the part of I^2 [m2] that is known in the step of the impact, zero for nodes that do not approach.

    Parameters
    ----------
    approach : a, displacement towards the wall without contact [m]
    arrival : d, distance to the wall [m]
    pull : p, contribution of forces to the approach [m]
    """
    square = approach * approach - pull * (approach - arrival)
    return np.where(approach > 0.0, np.maximum(square, 0.0), 0.0)


def rebound_way(
    restitution: np.ndarray | float, square: np.ndarray, arrival: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """Return w + q/2, the rebound velocity times the step [m]; 0 where ``square`` is 0.

    Parameters
    ----------
    restitution : e
    square, arrival : of the step of the impact, see :func:`impact_square`
    pull : q, towards the wall, by the forces at the position of impact [m]
    """
    whole = np.maximum(square + pull * arrival + 0.25 * pull * pull, 0.0)
    return np.where(square > 0.0, restitution * np.sqrt(whole), 0.0)
