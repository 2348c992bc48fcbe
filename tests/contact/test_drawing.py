"""Every wall type can be drawn, with its surface on the wall."""

import numpy as np
import pytest

from pfem_petsc.contact.walls import cylinder, rectangle, sphere
from pfem_petsc.post.motion import wall_surfaces

WALLS = [
    sphere.Parameters(name="w", type="sphere", point=(0.1, 0.2, 0.3), radius=0.5),
    cylinder.Parameters(name="w", type="cylinder", point=(0.1, 0.2, 0.3), axis=(1.0, 1.0, 0.2), radius=0.5),
    rectangle.Parameters(
        name="w", type="rectangle", point=(0, 0, 1.0), normal=(0, 0.5, 1.0), along=(1.0, 0, 0), size=(2.0, 1.0)
    ),
]


@pytest.mark.parametrize("parameters", WALLS, ids=lambda p: p.type)
def test_surface_is_on_the_wall(parameters):
    (surface,) = wall_surfaces([parameters], np.array([[-1.0, -1, -1], [1.0, 1, 1]]))
    module = {"sphere": sphere, "cylinder": cylinder, "rectangle": rectangle}[parameters.type]
    face = surface.points[surface.depth == 0.0]
    normals, offsets = module.Wall(parameters).planes(face)
    np.testing.assert_allclose(np.einsum("ij,ij->i", normals, face), offsets, atol=1e-12)
    assert surface.faces.max() < len(surface.points) and len(face) >= 4


def test_a_sphere_has_circles_across_each_other():
    """Three great circles, one in each plane of the axes; without them its picture is a disc."""
    (surface,) = wall_surfaces([WALLS[0]], np.array([[-1.0, -1, -1], [1.0, 1, 1]]))
    arms = surface.points[surface.edge] - np.array(WALLS[0].point)
    np.testing.assert_allclose(np.linalg.norm(arms, axis=2), WALLS[0].radius, rtol=1e-12)
    within = (np.abs(arms) < 1e-12).all(axis=1)  # which coordinate both ends lack
    assert within.any(axis=1).all() and (within.sum(axis=0) >= 32).all()
