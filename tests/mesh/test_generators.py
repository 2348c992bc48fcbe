from itertools import pairwise

import numpy as np
import pytest
from helpers.meshes import assert_part_of, stiffness_modes, whole
from mpi4py import MPI
from pydantic import ValidationError

from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice, mast, net, prism, ring, rod

GENERATED = {
    "rod": (rod, {"length": 2.0, "elements": 7}),
    "ring": (ring, {"outer_radius": 3.0, "inner_radius": 2.5, "bays": 9}),
    "ring_single_flat": (
        ring,
        {"outer_radius": 3.0, "inner_radius": 2.5, "bays": 8, "bracing": "single", "orientation": "flat"},
    ),
    "cubic": (lattice, {"kind": "cubic", "cells": [2, 3, 4], "pitch": 0.1}),
    "octet": (lattice, {"kind": "octet", "cells": [3, 2, 2], "pitch": 0.1}),
    "bcc": (lattice, {"kind": "bcc", "cells": [2, 2, 3], "pitch": 0.1}),
    "net": (net, {"size": [3.0, 2.0], "cells": [4, 3]}),
    "one_mesh": (net, {"size": [1.0, 1.0], "cells": [1, 1]}),
    "prism": (prism, {"radius": 0.5, "height": 1.0}),
    "prism_of_five": (prism, {"radius": 0.5, "height": 1.0, "sides": 5, "twist": 100.0}),
    "mast": (mast, {"height": 8.0, "width": 1.0, "bays": 5, "radius": 4.0, "levels": 2, "elements": 3}),
    "mast_of_one_bay": (mast, {"height": 1.0, "width": 1.0, "bays": 1, "radius": 2.0}),
    "one_cell": (lattice, {"kind": "cubic", "cells": [1, 1, 1], "pitch": 1.0}),
}


def made(module, comm, **keys):
    return module.generate(module.Parameters(**keys), comm.rank, comm.size)


def reference_cubic(n):
    """Edges and both face diagonals of n^3 cubes, in the order and numbering of the shared reference lattice."""
    m = n + 1
    k = np.arange(m**3).reshape(m, m, m)
    a, b, w = slice(0, n), slice(1, m), slice(None)
    pairs = [((a, w, w), (b, w, w)), ((w, a, w), (w, b, w)), ((w, w, a), (w, w, b)), ((a, a, w), (b, b, w))]
    pairs += [((b, a, w), (a, b, w)), ((a, w, a), (b, w, b)), ((b, w, a), (a, w, b)), ((w, a, a), (w, b, b))]
    pairs += [((w, b, a), (w, a, b))]
    return np.concatenate([np.stack([k[one].ravel(), k[two].ravel()], 1) for one, two in pairs])


@pytest.mark.parallel
@pytest.mark.parametrize("name", GENERATED)
def test_every_rank_makes_its_part_of_the_same_sound_mesh(comm, name):
    module, keys = GENERATED[name]
    assert_part_of(made(module, comm, **keys), made(module, MPI.COMM_SELF, **keys), comm)


@pytest.mark.parametrize(("n", "nodes", "bars"), [(10, 1_331, 10_230), (22, 12_167, 101_706), (48, 117_649, 1_023_120)])
def test_cubic_lattice_has_the_bars_of_the_reference(comm, n, nodes, bars):
    mesh = whole(made(lattice, comm, kind="cubic", cells=[n, n, n], pitch=0.01), comm)
    assert (mesh.n_nodes, mesh.n_bars) == (nodes, bars)
    np.testing.assert_array_equal(mesh.bars, reference_cubic(n))
    np.testing.assert_array_equal(mesh.points, np.indices((n + 1,) * 3).reshape(3, -1).T * 0.01)


@pytest.mark.parametrize("kind", ["cubic", "octet", "bcc"])
def test_lattice_faces_are_node_groups(comm, kind):
    cells, pitch = [2, 3, 4], 0.5
    mesh = whole(made(lattice, comm, kind=kind, cells=cells, pitch=pitch), comm)
    for axis, names in enumerate((("left", "right"), ("front", "back"), ("bottom", "top"))):
        for name, value in zip(names, (0.0, cells[axis] * pitch)):
            np.testing.assert_array_equal(
                np.sort(mesh.node_groups[name]), np.flatnonzero(np.isclose(mesh.points[:, axis], value))
            )


def test_rod_lies_on_the_x_axis(comm):
    mesh = whole(made(rod, comm, length=1.0, elements=20), comm)
    np.testing.assert_array_equal(mesh.points[:, 0], np.arange(21) / 20)
    assert not mesh.points[:, 1:].any()
    np.testing.assert_array_equal(mesh.bars, list(pairwise(range(21))))
    assert mesh.node_groups["start"].tolist() == [0]
    assert mesh.node_groups["end"].tolist() == [20]
    np.testing.assert_array_equal(mesh.bar_groups["rod"], np.arange(20))


@pytest.mark.parametrize("bracing", ["x", "single"])
@pytest.mark.parametrize("orientation", ["vertex", "flat"])
@pytest.mark.parametrize("bays", [7, 14])
def test_ring_is_a_braced_plane_truss(comm, bays, orientation, bracing):
    outer, inner = 22.83, 22.37
    keys = {"outer_radius": outer, "inner_radius": inner, "bays": bays, "bracing": bracing, "orientation": orientation}
    mesh = whole(made(ring, comm, **keys), comm)
    assert (mesh.n_nodes, mesh.n_bars) == (2 * bays, (5 if bracing == "x" else 4) * bays)
    radius = np.hypot(mesh.points[:, 0], mesh.points[:, 1])
    np.testing.assert_allclose(radius, np.repeat([outer, inner], bays), rtol=1e-14)
    length = np.linalg.norm(mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]], axis=1)
    half = np.pi / bays
    expected = {
        "outer": 2 * outer * np.sin(half),
        "inner": 2 * inner * np.sin(half),
        "radial": outer - inner,
        "diagonal": np.sqrt(outer**2 + inner**2 - 2 * outer * inner * np.cos(2 * half)),
    }
    assert list(mesh.bar_groups) == list(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(length[mesh.bar_groups[name]], value, rtol=1e-12)
    x = mesh.points[:, 0]
    np.testing.assert_array_equal(mesh.node_groups["impact"], np.flatnonzero(x > x.max() - 1e-9))
    np.testing.assert_array_equal(mesh.node_groups["opposite"], np.flatnonzero(x < x.min() + 1e-9))
    assert len(mesh.node_groups["impact"]) == (1 if orientation == "vertex" else 2)
    # Held in its plane it has the three rigid motions left, and each node's own motion out of the plane.
    assert stiffness_modes(mesh.points, mesh.bars) == 3 + 2 * bays


@pytest.mark.parametrize(
    ("module", "keys", "text"),
    [
        (rod, {"length": 1.0, "elements": 800_000_000}, "mesh.elements: 800,000,001 nodes"),
        (lattice, {"cells": [100_000, 100_000, 100_000], "pitch": 1.0}, "mesh.cells"),
    ],
)
def test_sizes_that_cannot_be_computed_with_are_refused(comm, module, keys, text):
    from petsc4py import PETSc

    if np.iinfo(PETSc.IntType).bits == 64 and "nodes" in text:
        pytest.skip("this PETSc numbers so many unknowns")
    with pytest.raises(InputError, match=text):
        made(module, comm, **keys)


@pytest.mark.parametrize(
    ("module", "keys"),
    [
        (ring, {"outer_radius": 1.0, "inner_radius": 1.0, "bays": 8}),
        (ring, {"outer_radius": 1.0, "inner_radius": 0.5, "bays": 2}),
        (rod, {"length": 1.0, "elements": 0}),
        (rod, {"length": 1e-300, "elements": 2}),
        (lattice, {"cells": [1, 1, 1], "pitch": 1e-300}),
        (lattice, {"kind": "cubic", "cells": [1, 1], "pitch": 1.0}),
        (lattice, {"kind": "kagome", "cells": [1, 1, 1], "pitch": 1.0}),
    ],
)
def test_keys_are_checked(module, keys):
    with pytest.raises(ValidationError):
        module.Parameters(**keys)


def test_corners_of_a_net_are_counted_from_the_origin(comm):
    mesh = whole(made(net, comm, size=[6.0, 5.0], cells=[3, 2]), comm)
    for k, corner in enumerate([(0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (0.0, 5.0)], 1):
        (node,) = mesh.node_groups[f"corner_{k}"]
        assert tuple(mesh.points[node]) == (*corner, 0.0)
