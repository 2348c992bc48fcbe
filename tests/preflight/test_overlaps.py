"""Overlapping bars, and nodes that lie on bars they are not connected to."""

import numpy as np
import pytest
from helpers.mesh_files import case_of

from pfem_petsc import Case, Simulation
from pfem_petsc.preflight import nodes_on_bars as search
from pfem_petsc.preflight.inspection import warnings_before
from pfem_petsc.preflight.nodes_on_bars import nodes_on_bars
from pfem_petsc.preflight.overlaps import overlapping_bars
from pfem_petsc.preflight.parts import count_parts

pytestmark = pytest.mark.parallel


def told(tmp_path, comm, points, bars):
    """Entries and warnings of ``check``."""
    return Simulation(case_of(tmp_path, comm, points, bars), comm, check_only=True).inspect()


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0]]


def test_bar_that_lies_along_two_others(comm, shared_tmp_path):
    """The slip: bar 4 from node 0 to node 2, and node 1 in the middle, connected to both."""
    bars = [(0, 1), (1, 2), (1, 3), (0, 3), (2, 0), (3, 2)]
    simulation = Simulation(case_of(shared_tmp_path, comm, TRIANGLE, bars), comm, check_only=True)
    (text,) = warnings_before(simulation.case, simulation.model, simulation.plan)
    assert text.startswith(
        "2 pairs of bars overlap from a common node on: bar 0 (nodes 0 and 1) and bar 4 (nodes 2 and 0), "
        "bar 1 (nodes 1 and 2) and bar 4 (nodes 2 and 0); "
    )
    last = simulation.inspect()[1][-1]
    assert last.startswith("1 node lies on a bar that it is not connected to: node 1 on bar 4 (nodes 2 and 0); ")


def test_bars_that_meet_or_cross_at_an_angle_are_sound(comm, shared_tmp_path):
    """Also at a small one, and where a bracing crosses another without a node."""
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [30.0, 0.02, 0.0]]
    bars = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3), (0, 4), (1, 4), (2, 4)]
    entries, warnings = told(shared_tmp_path, comm, square, bars)
    assert warnings == []
    assert "same place" not in entries
    assert "nodes on bars" not in entries


def test_overlaps_without_a_common_node(comm, shared_tmp_path):
    """Bars 0-2 and 1-3 on a line, in any direction and far from the origin; and a node in the middle of another bar."""
    random = np.random.default_rng(3)
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    points = np.array([[0, 0, 0], [0.4, 0, 0], [1, 0, 0], [1.3, 0, 0], [0.7, 0.5, 0.0], [0.7, -0.5, 0.0]])
    bars = [(0, 2), (1, 3), (0, 4), (3, 4), (1, 4), (2, 4), (4, 5), (5, 0)]
    _, warnings = told(shared_tmp_path, comm, 50.0 + points @ q, bars)
    (text,) = [text for text in warnings if "lie on bars" in text]
    on = "node 1 on bar 0 (nodes 0 and 2), node 2 on bar 1 (nodes 1 and 3)"
    assert text.startswith(f"2 nodes lie on bars that they are not connected to: {on}; ")
    assert not any("along each other" in text for text in warnings)


def test_nodes_that_were_not_merged(comm, shared_tmp_path):
    points = [*TRIANGLE, [1.0, 1.0, 1e-9], [3.0, 1.0, 0.0]]
    entries, _ = told(shared_tmp_path, comm, points, [(0, 1), (1, 2), (1, 3), (0, 3), (2, 4), (4, 5), (2, 5)])
    assert entries["same place"].startswith("2 nodes, nodes 3 and 4: merge them")


def test_nodes_on_bars_are_those_of_all_pairs(comm, shared_tmp_path):
    """Random bars of very different lengths through a grid of points, against a search of all pairs."""
    random = np.random.default_rng(8)
    points = random.integers(0, 6, size=(150, 3)).astype(float)
    points = np.unique(points, axis=0)
    points[:20] += 1e-3 * random.random((20, 3))
    chain = np.stack([np.arange(len(points) - 1), np.arange(1, len(points))], axis=1)
    bars = np.unique(np.concatenate([chain, np.sort(random.choice(len(points), (200, 2)), axis=1)]), axis=0)
    bars = bars[bars[:, 0] != bars[:, 1]]
    expected = 0
    for a, b in bars:
        axis = points[b] - points[a]
        s = (points - points[a]) @ axis / (axis @ axis)
        away = np.linalg.norm(points - points[a] - s[:, None] * axis, axis=1)
        on = (away < 1e-9) & (s > 1e-9) & (s < 1.0 - 1e-9)
        expected += int(on.sum())
    model = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True).model
    assert expected > 5
    assert nodes_on_bars(model.mesh).between == expected


def test_first_ones_shown_are_the_lowest_of_all(comm, shared_tmp_path):
    """Of 1,200 nodes on bars and as many pairs of coinciding nodes, from bars in no order."""
    n, random = 1200, np.random.default_rng(5)
    at = np.arange(n, dtype=float)[:, None] * [0.0, 1.0, 0.0]
    points = np.concatenate([at, at + [1.0, 0, 0], at + [0.5, 0, 0], at + [1.0, 0, 0]])
    chain = np.arange(n - 1)
    ladder = [(2 * n + chain, 2 * n + chain + 1), (3 * n + chain, 3 * n + chain + 1)]
    rungs = np.stack([np.arange(n), n + np.arange(n)], axis=1)[random.permutation(n)]
    bars = np.concatenate([rungs, *(np.stack(pair, axis=1) for pair in ladder), [[0, 2 * n], [n - 1, 4 * n - 1]]])
    found = nodes_on_bars(Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True).mesh)
    assert (found.between, found.coinciding) == (n + 1, 2 * n)  # the last bar passes a node as well
    assert found.shown_coinciding == [f"nodes {n + k} and {3 * n + k}" for k in range(5)]
    on = [f"node {2 * n + a} on bar {k} (nodes {a} and {b})" for k, (a, b) in enumerate(rungs[:5].tolist())]
    assert found.shown_between == on


def test_ranks_hold_the_nodes_near_their_bars(comm, monkeypatch):
    held = []
    near = search._near
    monkeypatch.setattr(search, "_near", lambda *given: held.append(near(*given)) or held[0])
    mesh = Simulation(Case.load("lattice_drop", ["mesh.cells=[60,2,2]"]), comm, check_only=True).mesh
    assert nodes_on_bars(mesh).between == 0
    if comm.size > 1:
        assert mesh.n_owned < len(held[0].keys) < 1.5 * mesh.n_nodes / comm.size


def test_nodes_on_bars_of_a_graded_mesh(comm, shared_tmp_path, monkeypatch):
    """Most nodes are crowded into a corner; where even that is too much, it is said."""
    x = np.concatenate([[0.0], np.geomspace(1e-5, 1.0, 3000)])
    points = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    bars = [*((i, i + 1) for i in range(3000)), (2990, 2992)]
    entries, warnings = told(shared_tmp_path, comm, points, bars)
    assert any("node 2991 on bar 3000" in text for text in warnings)
    monkeypatch.setattr(search, "_PIECES", 1.5)
    entries, warnings = told(shared_tmp_path, comm, points, bars)
    assert entries["nodes on bars"].startswith("not checked")


@pytest.mark.parametrize("name", ["rod_impact", "ring_impact", "lattice_drop", "tumbling_lattice"])
def test_generated_meshes_have_no_overlaps(comm, name):
    overrides = ["mesh.cells=[3,3,3]"] if name == "lattice_drop" else []
    mesh = Simulation(Case.load(name, overrides), comm, check_only=True).mesh
    assert overlapping_bars(mesh) == (0, [])
    assert nodes_on_bars(mesh)[::2] == (0, 0)


def test_many_parts_are_counted_where_their_lowest_nodes_are(comm, shared_tmp_path):
    """70 loose bars and a triangle; no rank has a list of all parts."""
    random = np.random.default_rng(6)
    numbers = random.permutation(143)
    bars = [*numbers[:140].reshape(-1, 2).tolist(), numbers[140:142].tolist(), numbers[141:].tolist()]
    points = random.random((143, 3))
    mesh = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True).mesh
    assert count_parts(mesh) == (71, 2, int(numbers[:140].min()))
