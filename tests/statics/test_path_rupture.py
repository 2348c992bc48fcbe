"""Paths beyond breaks of bars: closed forms of what is left, energies, restarts."""

import numpy as np
import pytest
from helpers.kills import differences
from helpers.runs import run

from pfem_petsc import Case, Simulation, open_result, write_mesh
from pfem_petsc.errors import InputError, SimulationFailure

YOUNG, AREA, DENSITY = 1e9, 1e-4, 1000.0
EA = YOUNG * AREA
WAY = {"node_set": "joint", "direction": [1.0, 0.0, 0.0]}


def truss(folder, comm, feet, limits, static, force=1e-4 * EA, **tables):
    """Bars from feet to a joint at the origin that is pulled along x and guided across."""
    points = [[0.0, 0.0, 0.0], *feet]
    groups = {f"g{k}": np.array([k]) for k in range(len(feet))}
    write_mesh(folder / "bars.h5", points, [[k + 1, 0] for k in range(len(feet))], bar_groups=groups, comm=comm)
    data = {
        "mesh": {"file": "bars.h5"},
        "node_set": {"feet": {"indices": list(range(1, len(points)))}, "joint": {"indices": [0]}},
        "material": {
            f"m{k}": {"young_modulus": YOUNG, "density": DENSITY, "rupture": limit} for k, limit in enumerate(limits)
        },
        "section": {f"s{k}": {"area": AREA, "material": f"m{k}", "bars": f"g{k}"} for k in range(len(feet))},
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "joint", "fix": "yz"}],
        "load": [{"node_set": "joint", "force": [force, 0.0, 0.0]}],
        "static": static,
        "output": {"fields_every": 1, "probe": [{"name": "joint", "node_set": "joint"}]},
    }
    return Case.from_dict({**data, **tables}, source="bars.toml", folder=folder)


def forces(feet, moved):
    """Axial forces (bars, points) at displacements of the joint along x, and what each adds to the load."""
    arms = np.array([[x, 0.0, 0.0] for x in moved])[None] - np.array(feet)[:, None]
    lengths, rest = np.linalg.norm(arms, axis=2), np.linalg.norm(feet, axis=1)[:, None]
    normal = EA * (lengths / rest - 1.0)
    return normal, normal * arms[:, :, 0] / lengths


LINE = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]  # one is pulled and one is pressed: two springs side by side


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["displacement", "arc_length"])
def test_two_bars_side_by_side(method, comm, shared_tmp_path):
    """The load falls to that of the second bar at once, rises with its stiffness, and to zero when it breaks too."""
    static = {"method": method, "step": 0.1, "max_step": 0.1, "displacement": 4e-4, **WAY}
    limits = [{"strain": 1.01e-4}, {"compressive_strain": 3.03e-4}]
    case = truss(shared_tmp_path, comm, LINE, limits, static)
    history = run(case, shared_tmp_path / "out", comm)
    moved = history["probe/joint/position"][:, 0, 0]
    left = 2 - history["broken_bars"]
    first, second = (int(np.argmax(moved >= limit)) for limit in (1.01e-4, 3.03e-4))
    np.testing.assert_array_equal(left, np.repeat([2, 1, 0], [first, second - first, len(moved) - second]))
    assert len(moved) == second + 1  # nothing is left to pull
    assert abs(moved[first] - 1.01e-4) <= 5e-6 and abs(moved[second] - 3.03e-4) < 5e-6
    np.testing.assert_allclose(1e-4 * EA * history["load_factor"], left * EA * moved, atol=1e-9 * EA * 1e-4)
    released = np.where(left < 2, 0.5 * EA * moved[first] ** 2, 0.0) + np.where(
        left < 1, 0.5 * EA * moved[-1] ** 2, 0.0
    )
    np.testing.assert_allclose(history["rupture_dissipation"], released, rtol=1e-11)
    scale = history["external_work"].max()
    np.testing.assert_allclose(history["external_work"], history["elastic_energy"] + released, atol=1e-9 * scale)
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * scale
    status = open_result(shared_tmp_path / "out").field("status", -1)
    assert np.asarray(status).tolist() == [1, 1]
    if comm.rank == 0:
        log = (shared_tmp_path / "out" / "log.txt").read_text()
        assert f"bar 0 broke at step {first}, load factor" in log and "-strain = 0.000305 >= 0.000303" in log
        assert "no remaining bar carries the load" in log


THREE = [[-1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]


@pytest.mark.parametrize("method", ["displacement", "arc_length"])
@pytest.mark.parametrize("steps", [1, 3])
def test_three_bar_truss(method, steps, comm, tmp_path):
    """Large displacements: the load is that of the bars that are left, exactly; the middle bar breaks first."""
    static = {"method": method, "step": 50.0, "max_step": 50.0, "displacement": 0.1, **WAY}
    limits = [{"stress": 0.031 * YOUNG, "steps": steps}, {"strain": 1.0}, {"strain": 1.0}]
    case = truss(tmp_path, comm, THREE, limits, static)
    history = run(case, tmp_path / "out", comm)
    moved = history["probe/joint/position"][:, 0, 0]
    normal, load = forces(THREE, moved)
    broken = normal[0] >= 0.031 * EA
    assert history["broken_bars"].tolist() == broken.tolist() and 2 < broken.sum() < len(broken) - 2
    expected = np.where(broken, 0.0, load[0]) + load[1] + load[2]
    np.testing.assert_allclose(1e-4 * EA * history["load_factor"], expected, atol=1e-8 * expected.max())
    factor = history["load_factor"]
    first = int(np.argmax(broken))
    assert factor[first] < 0.6 * factor[first - 1] and (np.diff(factor[first:]) > 0.0).all()
    assert moved[-1] == pytest.approx(0.1, rel=1e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * history["external_work"].max()


def test_a_mechanism_ends_the_path_with_the_reason(comm, tmp_path):
    """Two bars in a row carry the load from the joint; without the second, the first turns about the joint's guide."""
    points = [[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]
    write_mesh(tmp_path / "row.h5", points, [[0, 1], [1, 2]], bar_groups={"weak": np.array([1])}, comm=comm)
    material = {"young_modulus": YOUNG, "density": DENSITY}
    changes = {
        "mesh": {"file": "row.h5"},
        "node_set": {"feet": {"indices": [2]}, "joint": {"indices": [0]}, "rest": {"indices": [0, 1]}},
        "material": {"it": material, "weak": {**material, "rupture": {"strain": 1e-5}}},
        "section": {"it": {"area": AREA, "material": "it"}, "w": {"area": AREA, "material": "weak", "bars": "weak"}},
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "rest", "fix": "yz"}],
    }
    static = {"method": "displacement", "step": 0.1, "displacement": 1e-3, **WAY}
    case = truss(tmp_path, comm, LINE, [{"strain": 1.0}] * 2, static, **changes)
    with pytest.raises(
        SimulationFailure, match="finds no equilibrium at this displacement after bars broke"
    ) as failure:
        Simulation(case, comm, output=tmp_path / "out", quiet=True).run()
    assert "The stiffness leaves 1 motion free" in str(failure.value)


def test_removals_are_refused(comm, tmp_path):
    static = {"method": "displacement", "step": 0.1, "displacement": 1e-2, **WAY}
    case = truss(tmp_path, comm, LINE, [{"strain": 1.0}] * 2, static, remove=[{"bars": "g0", "time": 0.5}])
    with pytest.raises(InputError, match=r"can pass a load factor several times"):
        Simulation(case, comm, output=tmp_path / "out", quiet=True)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("method", ["displacement", "arc_length"])
def test_the_path_goes_on_beside_a_node_that_has_lost_its_bars(method, operator, comm, shared_tmp_path):
    """Two bars in a row opposite to one that stays break at once; the node between them stays where it is."""
    folder = shared_tmp_path
    points = [[0.0, 0, 0], [-1.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]]
    write_mesh(folder / "beside.h5", points, [[0, 1], [0, 2], [2, 3]], bar_groups={"row": np.array([1, 2])}, comm=comm)
    material = {"young_modulus": YOUNG, "density": DENSITY}
    changes = {
        "mesh": {"file": "beside.h5"},
        "node_set": {"feet": {"indices": [1, 3]}, "joint": {"indices": [0]}, "between": {"indices": [2]}},
        "material": {"it": material, "weak": {**material, "rupture": {"compressive_strain": 4.1e-5}}},
        "section": {"it": {"area": AREA, "material": "it"}, "w": {"area": AREA, "material": "weak", "bars": "row"}},
        "support": [{"node_set": "feet", "fix": "xyz"}] + [{"node_set": n, "fix": "yz"} for n in ("joint", "between")],
        "solver": {"operator": operator, "linear": "cg", "rtol": 1e-12} if operator == "matrix_free" else {},
        "output": {"fields_every": 1, "checkpoint_every": 4, "probe": [{"name": "joint", "node_set": "joint"}]},
    }
    static = {"method": method, "step": 0.1, "max_step": 0.1, "displacement": 1e-4, **WAY}
    case = truss(folder, comm, LINE, [{"strain": 1.0}] * 2, static, **changes)
    history = run(case, folder / "whole", comm)
    moved, broken = history["probe/joint/position"][:, 0, 0], history["broken_bars"]
    assert set(broken.tolist()) == {0, 2} and (broken == 0).sum() > 5 and (broken > 0).sum() > 5
    expected = np.where(broken > 0, 1.0, 2.0) * EA * moved
    np.testing.assert_allclose(1e-4 * EA * history["load_factor"], expected, atol=1e-8 * EA * 1e-4)
    assert moved[-1] == pytest.approx(1e-4, rel=1e-9)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["external_work"].max()
    stop = int(np.argmax(broken > 0)) + 3
    with Simulation(case, comm, output=folder / "parts", quiet=True) as simulation:
        for made in simulation:
            if made.step == stop:
                break
    assert Simulation(case, comm, output=folder / "parts", restart=True, quiet=True).run() == 0
    if comm.rank == 0:
        files = [folder / name / "result.vtkhdf" for name in ("whole", "parts")]
        if comm.size == 1:
            assert differences(*files) == {}
        one, other = (open_result(file).history["load_factor"] for file in files)
        np.testing.assert_allclose(other, one, rtol=1e-8)
