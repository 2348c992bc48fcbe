"""What names select of the columns of a history."""

import numpy as np
import pytest

from pfem_petsc.errors import InputError
from pfem_petsc.output.table import selected

TIME = np.linspace(0.0, 1.0, 5)
GROUND = np.stack([0.1 * np.sin(TIME), 0.0 * TIME, 0.0 * TIME], axis=1)
ROOF = np.stack([GROUND + [5.0, 0.0, 3.0] + [[0.01 * k, 0.0, 0.0] for k in range(5)], GROUND + [9.0, 0.0, 3.0]], axis=1)
HISTORY = {"time": TIME, "probe/ground/position": GROUND[:, None], "probe/roof/position": ROOF}


def test_displacement_relative_to_the_ground():
    """Of two nodes, one of which moves by 0.01 m a row against the ground: their mean by half of this."""
    found = selected(HISTORY, "probe/roof/displacement.x - probe/ground/displacement.x")
    np.testing.assert_allclose(found, 0.005 * np.arange(5), atol=1e-15)
    vectors = selected(HISTORY, "probe/roof/displacement - probe/ground/displacement")
    np.testing.assert_allclose(vectors, np.outer(0.005 * np.arange(5), [1.0, 0.0, 0.0]), atol=1e-15)
    node = selected(HISTORY, "probe/roof/displacement[0].x - probe/ground/displacement[0].x")
    np.testing.assert_allclose(node, 0.01 * np.arange(5), atol=1e-15)


def test_differences_that_are_none():
    with pytest.raises(InputError, match="one is a vector and the other is not"):
        selected(HISTORY, "probe/roof/position - time")
    with pytest.raises(InputError, match="no column 'probe/grund/position', did you mean"):
        selected(HISTORY, "probe/roof/position - probe/grund/position")
