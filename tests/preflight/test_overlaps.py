"""Parts, divided members, and nodes that lie on bars they are not connected to."""

import numpy as np
import pytest
from helpers.runs import inspected
from helpers.small_models import TRUSSES, case_of

from pfem_petsc import Case
from pfem_petsc.registry import lookup


@pytest.fixture
def told(comm, shared_tmp_path):
    """Entries and warnings of ``check`` for a mesh."""
    return lambda points, bars, fixed=(): inspected(case_of(shared_tmp_path, comm, points, bars, fixed), comm)


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]]


def test_bar_that_lies_along_two_others(told):
    """The slip: bar 4 from node 0 to node 2, and node 1 in the middle, connected to both."""
    _, (lies,) = told(TRIANGLE, [(0, 1), (1, 2), (1, 3), (0, 3), (2, 0), (3, 2)])
    assert lies.startswith("1 node lies on a bar that it is not connected to: node 1 on bar 4 (nodes 2 and 0); ")


def test_bars_that_meet_or_cross_at_an_angle_are_sound(told):
    """Also at a small one, and where a bracing crosses another without a node."""
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [30.0, 0.02, 0.0]]
    entries, warnings = told(square, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3), (0, 4), (1, 4), (2, 4)])
    assert warnings == []
    assert not {"same place", "nodes on bars"} & set(entries)


@pytest.mark.parallel
def test_overlaps_without_a_common_node(told):
    """Bars 0-2 and 1-3 on a line, in any direction and far from the origin; and a node in the middle of another bar."""
    q, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    points = np.array([[0, 0, 0], [0.4, 0, 0], [1, 0, 0], [1.3, 0, 0], [0.7, 0.5, 0.0], [0.7, -0.5, 0.0]])
    bars = [(0, 2), (1, 3), (0, 4), (3, 4), (1, 4), (2, 4), (4, 5), (5, 0)]
    _, warnings = told(50.0 + points @ q, bars)
    (text,) = [text for text in warnings if "lie on bars" in text]
    on = "node 1 on bar 0 (nodes 0 and 2), node 2 on bar 1 (nodes 1 and 3)"
    assert text.startswith(f"2 nodes lie on bars that they are not connected to: {on}; ")


def test_nodes_that_were_not_merged(told):
    points = [*TRIANGLE, [1.0, 1.0, 1e-9], [3.0, 1.0, 0.0]]
    entries, _ = told(points, [(0, 1), (1, 2), (1, 3), (0, 3), (2, 4), (4, 5), (2, 5)])
    assert entries["same place"].startswith("2 nodes, nodes 3 and 4: merge them")


@pytest.mark.parallel
def test_nodes_on_bars_are_those_of_all_pairs(told):
    """Random bars of very different lengths through a grid of points, against a search of all pairs."""
    random = np.random.default_rng(8)
    points = np.unique(random.integers(0, 6, size=(150, 3)).astype(float), axis=0)
    points[:20] += 1e-3 * random.random((20, 3))
    chain = np.stack([np.arange(len(points) - 1), np.arange(1, len(points))], axis=1)
    bars = np.unique(np.concatenate([chain, np.sort(random.choice(len(points), (200, 2)), axis=1)]), axis=0)
    bars = bars[bars[:, 0] != bars[:, 1]]
    expected = 0
    for a, b in bars:
        axis = points[b] - points[a]
        s = (points - points[a]) @ axis / (axis @ axis)
        away = np.linalg.norm(points - points[a] - s[:, None] * axis, axis=1)
        expected += np.count_nonzero((away < 1e-9) & (s > 1e-9) & (s < 1.0 - 1e-9))
    assert expected > 5
    assert any(text.startswith(f"{expected} nodes lie on bars") for text in told(points, bars)[1])


def test_lengths_that_differ_too_much_for_a_search_are_told(told):
    x = np.append(1e-9 * np.arange(4000), 1.0)
    points = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
    entries, _ = told(points, [(i, i + 1) for i in range(4000)])
    assert entries["nodes on bars"].startswith("not checked")


@pytest.mark.parametrize("name", ["rod_impact", "ring_impact", "lattice_drop", "tumbling_lattice"])
def test_generated_meshes_have_no_overlaps(comm, name, shared_tmp_path):
    """Nor when they are read from arrays, whose nodes and bars are checked."""
    mesh = Case.load(name, ["mesh.cells=[3,3,3]"] if name == "lattice_drop" else []).mesh
    slab = lookup("pfem_petsc.mesh.generators", mesh.generator, "").generate(mesh.parameters, 0, 1)
    entries, warnings = inspected(case_of(shared_tmp_path, comm, slab.points, slab.bars), comm)
    assert not {"same place", "nodes on bars"} & set(entries)
    assert not any("on bars" in text for text in warnings)


@pytest.mark.parallel
@pytest.mark.parametrize(("sizes", "seed"), [((60, 41, 7), 4), ((3, *(2,) * 70), 6)])
def test_parts(told, sizes, seed):
    """Rings of bars, and loose bars, whose numbers wander."""
    random = np.random.default_rng(seed)
    numbers, points = random.permutation(sum(sizes)), random.random((sum(sizes), 3))
    rings = np.split(numbers, np.cumsum(sizes)[:-1])
    bars = [pair for ring in rings for pair in list(zip(ring, np.roll(ring, 1), strict=True))[: len(ring) * 2 - 3]]
    entries, warnings = told(points, bars)
    assert entries["parts"] == f"{len(sizes)} that no bar connects"
    lowest = min(int(ring.min()) for ring in rings if len(ring) == min(sizes))
    text = f"in {len(sizes)} parts that no bar connects; the smallest has {min(sizes)} nodes, node {lowest} among them"
    assert any(text in told for told in warnings)


def divided(points, bars, parts):
    """A truss as a mesh generator leaves it: each bar in so many parts."""
    points, divided_bars = [list(point) for point in points], []
    for a, b in bars:
        start, way = np.array(points[a]), np.subtract(points[b], points[a])
        inner = range(len(points), len(points) + parts - 1)
        points += [(start + way * k / parts).tolist() for k in range(1, parts)]
        chain = [a, *inner, b]
        divided_bars += list(zip(chain[:-1], chain[1:]))
    return points, divided_bars


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize("parts", [1, 2, 5])
def test_subdivided_members_are_told(told, parts):
    """All inner nodes of the members, also where a member's direction is general; not what a support holds."""
    points, bars, _, _ = TRUSSES["tetrahedron"]
    points = np.array(points) @ np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    _, warnings = told(*divided(points, bars, parts), [] if parts == 1 else [len(points)])
    found = [text for text in warnings if "Transfinite Curve {:} = 2" in text]
    count = len(bars) * (parts - 1) - 1
    assert [text.startswith(f"{count} nodes can move freely") for text in found] == [True] * (parts > 1)


def test_a_rod_is_no_subdivided_truss(told):
    points = [[0.1 * k, 0.0, 0.0] for k in range(8)]
    assert not any("can move freely" in text for text in told(points, [[k, k + 1] for k in range(7)])[1])
