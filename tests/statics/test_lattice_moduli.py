"""Young's modulus of the octet lattice from compression of blocks, extrapolated over their sizes.

With the relative density rho: E100 = rho E/9 and E111 = rho E/5 (affine deformation of the infinite lattice;
Deshpande, Fleck and Ashby 2001). Blocks are stiffer or softer by their surfaces: a polynomial in 1/size.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import case_of

from pfem_petsc import Case, Simulation

YOUNG, AREA = 1e9, 1e-6
DENSITY = 6.0 * np.sqrt(2.0) * AREA  # relative, of bars of length 1
SHORTENED = 1e-7
SETS = {  # what the plates press on
    "bottom": lambda x: np.isclose(x[:, 2], 0.0),
    "top": lambda x: np.isclose(x[:, 2], x[:, 2].max()),
}


def along_cube_edge(size):
    """Points of a block of octet cells between (100) planes, with bars of length 1, and its base [m2]."""
    cell = np.sqrt(2.0)
    grid = np.indices((2 * size + 1,) * 3).reshape(3, -1).T
    return 0.5 * cell * grid[grid.sum(axis=1) % 2 == 0], (size * cell) ** 2


def along_space_diagonal(size):
    """The same with the axis z along (111): triangular layers, each shifted to the hollows of the one below."""
    root, layer = np.sqrt(3.0), np.sqrt(6.0) / 3.0
    width, depth, layers = 2.0 * size, root * size, 3 * size
    i, j, k = np.meshgrid(np.arange(-6 * size, 4 * size), np.arange(-2 * size, 3 * size), np.arange(layers + 1))
    points = np.stack([i + 0.5 * j + 0.5 * k, root * (0.5 * j + k / 6.0), layer * k], axis=-1).reshape(-1, 3)
    inside = (points[:, :2] > -1e-9).all(axis=1) & (points[:, 0] < width + 1e-9) & (points[:, 1] < depth + 1e-9)
    return points[inside], width * depth


def neighbours(points):
    """Bars between points at distance 1."""
    pairs = []
    for first in range(len(points)):
        apart = np.linalg.norm(points[first + 1 :] - points[first], axis=1)
        pairs.append([(first, first + 1 + other) for other in np.flatnonzero(np.isclose(apart, 1.0))])
    return [pair for some in pairs for pair in some]


def modulus(folder, comm, points, base):
    """Stress over strain of a block between plates, over rho E."""
    height = points[:, 2].max()
    bottom = np.flatnonzero(SETS["bottom"](points))
    middle = points[bottom].mean(axis=0)
    pin = bottom[np.argmin(np.linalg.norm(points[bottom] - middle, axis=1))]
    beside = bottom[np.argmax(points[bottom, 0] - 10.0 * abs(points[bottom, 1] - points[pin, 1]))]
    motion = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -SHORTENED * height]]
    tables = {
        "node_set": {name: {"indices": np.flatnonzero(place(points)).tolist()} for name, place in SETS.items()}
        | {"pin": {"indices": [int(pin)]}, "beside": {"indices": [int(beside)]}},
        "material": {"m": {"young_modulus": YOUNG, "density": 1000.0}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "support": [
            {"node_set": "bottom", "fix": "z"},
            {"node_set": "top", "fix": "z", "motion": motion, "interpolation": "linear"},
            {"node_set": "pin", "fix": "xy"},
            {"node_set": "beside", "fix": "y"},
        ],
        "static": {"step": 1.0},
        "output": {"fields_every": 0, "probe": [{"name": "bottom", "node_set": "bottom"}]},
    }
    case: Case = case_of(folder, comm, points, neighbours(points), **tables)
    with Simulation(case, comm, output=folder / f"out{len(points)}", quiet=True) as simulation:
        simulation.run()
        force = np.asarray(simulation.row["probe/bottom/reaction"])[:, 2].sum()
    return float(force) / base / SHORTENED / (DENSITY * YOUNG)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("block", "sizes", "expected"),
    [(along_cube_edge, (2, 3, 4, 5), 1.0 / 9.0), (along_space_diagonal, (2, 3, 4), 1.0 / 5.0)],
)
def test_modulus(tmp_path, comm, block, sizes, expected):
    found = [modulus(tmp_path, comm, *block(size)) for size in sizes]
    powers = np.vander(1.0 / np.array(sizes), len(sizes), increasing=True)
    assert np.linalg.solve(powers, found)[0] == pytest.approx(expected, rel=3e-3)
    assert abs(found[-1] / expected - 1.0) > 0.01  # surfaces count: it is the extrapolation that finds it
