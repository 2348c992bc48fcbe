"""Cleaning, merging, refining and scaling of meshes, and what is told about them."""

import numpy as np
import pytest

from pfem_petsc import Truss
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.tools import cleaned, coincident, components, lengths, merged, refined, scaled, summary
from pfem_petsc.mesh.whole import WholeMesh


def square(source="square.msh", shift=0.0, **more):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float) + [shift, 0.0, 0.0]
    bars = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]])
    groups = {"node_groups": {"left": np.array([0, 3])}, "bar_groups": {"diagonal": np.array([4])}}
    return WholeMesh(points, bars, **(groups | more), source=source)


def test_two_squares_are_joined_at_their_edge():
    mesh, done = merged([square(), square("right.msh", 1.0 + 3e-7, bar_fields={"area": np.ones(5)})])
    assert (len(mesh.points), len(mesh.bars)) == (6, 9)
    assert mesh.points.tolist()[:4] == square().points.tolist()
    assert {name: numbers.tolist() for name, numbers in mesh.bar_groups.items()} == {
        "diagonal": [4, 8],
        "square": [0, 1, 2, 3, 4],
        "right": [1, 5, 6, 7, 8],  # the edge is that of the first file
    }
    assert mesh.node_groups["left"].tolist() == [0, 1, 2, 3] and mesh.node_groups["right"].tolist() == [1, 2, 4, 5]
    assert done == [
        "field area left out: not all files have it",
        "2 nodes merged with others within 1.08284e-06 m",
        "1 bars between the same nodes as another one removed",
    ]
    apart, _ = merged([square(), square("right.msh", 1.0 + 3e-7)], 1e-8)
    assert (len(apart.points), len(apart.bars)) == (8, 10)


def test_everything_that_cleaning_removes():
    points = [[0, 0, 0], [9, 9, 9], [1, 0, 0], [1, 0, 1e-9], [2, 0, 0], [-0.0, 0, 0]]
    bars = np.array([[0, 2], [2, 3], [3, 4], [4, 2], [5, 2], [3, 3]])
    mesh = WholeMesh(np.array(points, float), bars, {"free": np.array([1, 5])}, {"some": np.array([1, 3, 4])},
                     {"area": np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])})  # fmt: skip
    result, done = cleaned(mesh, 1e-8)
    assert result.points.tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    assert result.bars.tolist() == [[0, 1], [1, 2]]
    assert result.node_groups["free"].tolist() == [0] and result.bar_groups["some"].tolist() == [0, 1]
    assert result.bar_fields["area"].tolist() == [1.0, 4.0]
    assert [line.split(" ")[0] for line in done] == ["2", "2", "2", "1"]
    summed, _ = cleaned(mesh, 1e-8, sum_areas=True)
    assert summed.bar_fields["area"].tolist() == [17.0, 12.0]
    told = dict(summary(mesh, 1e-8))
    assert told["nodes at the place of another"] == "2 (within 1e-08 m): 2 and 3, 0 and 5"
    assert told["bars without length"] == "2: 1, 5" and told["nodes without bars"] == "1: 1"
    assert "bars between the nodes of another" not in told  # before their nodes are merged
    assert dict(summary(WholeMesh(mesh.points, bars[[0, 0, 1]])))["bars between the nodes of another"] == "1: 0 and 1"
    again, done = cleaned(result, 1e-8)
    assert done == [] and again.bars.tolist() == result.bars.tolist()


def test_nodes_at_one_place_against_all_pairs():
    """Random clusters, against all distances; neighbours in any direction over cells of any grid."""
    random = np.random.default_rng(3)
    tolerance = 1e-3
    centres = random.uniform(-5, 5, (40, 3))
    points = centres[random.integers(0, 40, 300)] + random.uniform(-0.6e-3, 0.6e-3, (300, 3))
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= tolerance
    expected = components(300, np.argwhere(near))
    np.testing.assert_array_equal(coincident(points, tolerance), expected)
    assert len(np.unique(expected)) < 120
    exact = np.repeat(points[:50], 2, axis=0)
    np.testing.assert_array_equal(coincident(exact, 0.0), np.repeat(np.arange(0, 100, 2), 2))


def test_coordinates_that_are_not_numbers_are_told_with_their_file():
    mesh = square()
    mesh.points[2, 0] = np.nan
    for look in (summary, cleaned):
        with pytest.raises(InputError, match="square.msh: node 2 has coordinates that are not finite"):
            look(mesh)


def test_parts_of_a_long_chain():
    order = np.random.default_rng(1).permutation(1000)
    pairs = np.stack([order[:-1], order[1:]], axis=1)[np.arange(999) != 500]
    root = components(1000, pairs)
    assert sorted(np.unique(root, return_counts=True)[1].tolist()) == [499, 501]
    assert np.array_equal(root[root], root) and (root <= np.arange(1000)).all()


def test_refined_bars():
    mesh = square(bar_fields={"area": np.arange(1.0, 6.0)})
    fine = refined(mesh, 3)
    assert (len(fine.points), len(fine.bars)) == (4 + 10, 15)
    np.testing.assert_allclose(lengths(fine), np.repeat(lengths(mesh), 3) / 3)
    assert fine.bar_groups["diagonal"].tolist() == [12, 13, 14] and fine.node_groups["left"].tolist() == [0, 3]
    assert fine.bar_fields["area"].tolist() == np.repeat(np.arange(1.0, 6.0), 3).tolist()
    np.testing.assert_allclose(fine.points[4:6], [[1 / 3, 0, 0], [2 / 3, 0, 0]])
    assert refined(mesh, 1).bars.tolist() == mesh.bars.tolist()
    with pytest.raises(InputError, match="refine: 0 parts of a bar"):
        refined(mesh, 0)


def test_units_of_millimetres():
    """MPa are 1e6 Pa, t/mm3 are 1e12 kg/m3."""
    keys = {"young_modulus": 2.1e5, "density": 7.85e-9, "yield_stress": 250.0, "thermal_expansion": 1e-5}
    keys |= {"curve": [[0.1, 300.0]], "damping": 7.85e-9}
    tables = {"material": {"m": keys}, "section": {"s": {"area": 3.0, "thickness": 2.0, "bars": "diagonal"}}}
    mesh = scaled(square(bar_fields={"area": np.full(5, 3.0), "load": np.ones(5)}, tables=tables), 1e-3)
    np.testing.assert_allclose(mesh.points, 1e-3 * square().points)
    np.testing.assert_allclose(mesh.bar_fields["area"], 3e-6)
    assert mesh.bar_fields["load"].tolist() == [1.0] * 5
    found = mesh.tables["material"]["m"]
    expected = {"young_modulus": 2.1e11, "density": 7850.0, "yield_stress": 2.5e8, "thermal_expansion": 1e-5}
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-14)
    assert found["curve"] == [[0.1, pytest.approx(3e8)]] and found["damping"] == pytest.approx(7850.0)
    assert mesh.tables["section"]["s"] == {"area": pytest.approx(3e-6), "thickness": 0.002, "bars": "diagonal"}
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="scale: .* is not a positive number"):
            scaled(square(), wrong)


def test_summary_of_a_lattice():
    """An octet cell of pitch 1: 14 nodes; 24 struts of its faces and 12 of its octahedron, all 1/sqrt(2) long."""
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=(1, 1, 1), pitch=1.0), 0, 1)
    mesh = WholeMesh(slab.points, slab.bars, slab.node_groups, slab.bar_groups, {"area": np.full(36, 0.01)})
    told = dict(summary(mesh))
    assert (told["nodes"], told["bars"], told["parts"]) == ("14", "36", "1")
    assert told["lengths"] == "0.707107 to 0.707107 m, mean 0.707107 m, total 25.4558 m"
    assert told["volume"] == "0.254558 m3" and told["size"] == "1 x 1 x 1 m"
    assert told["bars at a node"] == "3 (8 nodes), 8 (6 nodes)"
    assert "face_struts (24)" in told["bar groups"] and not any("another" in label for label in told)


def test_python_reads_and_cleans(tmp_path):
    from pfem_petsc.formats import write_whole

    mesh = square(bar_fields={"area": np.ones(5), "w": np.zeros(5)})
    mesh.points = np.concatenate([mesh.points, [[5.0, 5.0, 5.0]]])
    path = write_whole(tmp_path / "s.h5", mesh)
    with pytest.raises(InputError, match=r"1 nodes belong to no bar: node 4; .*mesh clean .*s.h5 s_clean.h5"):
        Truss.read(path)
    truss = Truss.read(path, clean=0.0)
    assert (truss.n_nodes, truss.n_bars, sorted(truss.bar_fields)) == (4, 5, ["area", "w"])
    assert list(Truss.read(truss.write(tmp_path / "t.vtu"), bar_fields=["w"]).bar_fields) == ["w"]
    with pytest.raises(InputError, match="bar_fields = 'x': .*t.vtu has no field of this name"):
        Truss.read(tmp_path / "t.vtu", bar_fields=["x"])
