"""Bars that pass through each other are counted at snapshots, on any number of ranks, and told once and at the end."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.contact.neighbours import CrossingBars
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.stepping.model import Model


def rods(points, bars, radius, **tables):
    """Bars of a radius that cannot move, unless tables say so."""
    keys = {
        "node_set": {"all": {"all": True}, "moving": {"indices": [2, 3]}},
        "material": {"it": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"it": {"area": np.pi * radius**2, "material": "it"}},
        "support": [{"node_set": "all", "fix": "xyz"}],
        "time": {"integrator": "central_differences", "step": 1e-2, "end": 1.0},
        **tables,
    }
    return Case(keys, mesh=Truss(points, bars))


def to_segment(p, a, b):
    """Distance of points from a segment."""
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t * (b - a))


def distance(a, b, c, d):
    """Of two segments: of an end from the other, or of the lines where both feet lie inside."""
    found = [to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)]
    st = np.linalg.lstsq(np.stack([b - a, c - d], axis=1), c - a, rcond=None)[0]
    if np.all((st > 0.0) & (st < 1.0)):
        found.append(np.linalg.norm(a + st[0] * (b - a) - c - st[1] * (d - c)))
    return min(found)


@pytest.mark.parallel
@pytest.mark.parametrize(("seed", "longest"), [(1, 1.0), (2, 30.0)])
def test_pairs_are_those_of_every_pair_compared(seed, longest, comm):
    generator, n, radius = np.random.default_rng(seed), 60, 0.02
    bars = np.arange(2 * n).reshape(n, 2)
    bars[20, 0], bars[21, 1] = bars[5, 0], bars[5, 1]  # these share nodes
    length = np.where(generator.random(n) < 0.1, longest, 0.3)
    middle, way = generator.random((n, 3)) - 0.5, generator.normal(size=(n, 3))
    way *= 0.5 * (length / np.linalg.norm(way, axis=1))[:, None]
    placed = np.stack([middle - way, middle + way], axis=1).reshape(-1, 3)
    apart = placed + 100.0 * np.repeat(np.arange(n), 2)[:, None] * [0.0, 0.0, 1.0]
    nodes, bars = np.unique(bars, return_inverse=True)
    apart, placed, bars = apart[nodes], placed[nodes], bars.reshape(n, 2)
    model = Model(rods(apart, bars, radius), comm)
    ends = placed[bars]
    pairs = [
        (i, j)
        for i in range(n)
        for j in range(i + 1, n)
        if not set(bars[i]) & set(bars[j]) and distance(*ends[i], *ends[j]) < 2.0 * radius
    ]
    found = CrossingBars(model).find(placed[model.mesh.node_ids])
    assert len(pairs) > 5
    assert found == (len(pairs), len({bar for pair in pairs for bar in pair}), min(pairs))
    # in the mesh itself nothing is new, wherever it is
    assert CrossingBars(model).find(model.mesh.points + 1e3).pairs == 0


def test_pairs_that_cross_in_the_mesh_do_not_count_wherever_they_are(comm):
    """A bracing whose bars cross in the mesh, and a third bar that moves into both of them."""
    points = np.array([[0.0, 0, 0], [1, 1, 0], [1, 0, 0.03], [0, 1, 0.03], [0.5, 0.5, 5.0], [0.5, 0.6, 6.0]])
    model = Model(rods(points, np.array([[0, 1], [2, 3], [4, 5]]), 0.02), comm)
    search = CrossingBars(model)
    assert search.find(model.mesh.points).pairs == 0
    moved = points + [0.0, 0.0, 1.0]
    moved[0], moved[4], moved[5] = [0.0, 0.0, 1.01], [0.5, 0.5, 0.5], [0.5, 0.5, 1.5]
    assert search.find(moved[model.mesh.node_ids]) == (2, 3, (0, 2))
    assert search.find(model.mesh.points).pairs == 0


def falling_onto(others):
    """A bar that falls through one at rest at 1 m/s, between 0.38 s and 0.62 s, and others far away; a snapshot every
    0.1 s."""
    points = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0.5], [0, 1, 0.5]])
    ends = np.array([[0.0, 0, 5], [1, 0, 5]])
    points = np.concatenate([points, *(ends + [0.0, 0.0, k] for k in range(others))])
    tables = {
        "support": [
            {"node_set": "rest", "fix": "xyz"},
            {
                "node_set": "moving",
                "fix": "xyz",
                "motion": [[0.0, 0, 0, 0], [1.0, 0, 0, -1.0]],
                "interpolation": "linear",
            },
        ],
        "node_set": {"rest": {"indices": [0, 1, *range(4, len(points))]}, "moving": {"indices": [2, 3]}},
        "output": {"fields_every": 10, "checkpoint_every": 60},
    }
    return rods(points, np.arange(len(points)).reshape(-1, 2), 0.06, **tables)


@pytest.mark.slow
def test_searches_of_many_bars_have_growing_intervals(comm, shared_tmp_path):
    """With 12,500 bars, at snapshots 0, 1, 3, 5, 8 and the last, 10: of those in contact, 4 to 6, at one."""
    simulation = Simulation(falling_onto(12_498), comm, output=shared_tmp_path / "it", quiet=True)
    assert simulation.run() == 0
    counts = simulation.outputs.snapshots.kept()["doubts"]["crossing"]
    assert (counts["seen"], counts["looks"], counts["most"], counts["first"]) == (1, 6, 1, "step 50, t = 0.5 s")


@pytest.mark.parallel
def test_first_crossing_is_told_once_and_counted_at_the_end(comm, shared_tmp_path, capfd):
    case = falling_onto(1)
    # at 1 m/s, the axes are closer than 0.12 m between 0.38 s and 0.62 s: snapshots at 0.4, 0.5 and 0.6 s
    told = "bars passed through each other in 3 of 11 snapshots, first at step 40, t = 0.4 s: up to 1 pairs "
    told += "(2 bars, 66.7 %"
    assert Simulation(case, comm, output=shared_tmp_path / "it", quiet=True).run() == 0
    error = capfd.readouterr().err
    if comm.rank == 0:
        assert error.count("step 40, t = 0.4 s: 1 pair of bars passes through each other (66.7 % of all bars") == 1
        assert "bars 0 and 1 among them" in error
        assert told in (shared_tmp_path / "it" / "log.txt").read_text()


@pytest.mark.parallel
def test_nodes_that_have_strayed_do_not_end_the_search(comm, shared_tmp_path):
    """Squares of distances of such nodes are not finite; history rows, which report a divergence, may be rare."""
    case = Case.from_dict(
        {
            "material": {"m": {"young_modulus": 1e-200, "density": 1e-10}},
            "section": {"s": {"area": 1e-10, "material": "m"}},
            "node_set": {"one": {"indices": [0]}},
            "initial": {"on": [{"node_set": "one", "velocity": [1e150, 0.0, 0.0]}]},
            "time": {"integrator": "central_differences", "step": 1e6, "end": 4e6},
            "output": {"fields_every": 1, "history_every": 1000},
        },
        mesh=Truss(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), np.array([[0, 1], [2, 3], [1, 2]])),
    )
    with pytest.raises(SimulationFailure, match="not finite|zero length"):
        Simulation(case, comm, output=shared_tmp_path / "it", quiet=True).run()
