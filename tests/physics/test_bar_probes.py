"""Bars of probes in the history: closed forms, forces from positions, ranks, ruptures, stages, restarts."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import ARCH_AREA, ARCH_YOUNG, AREA, YOUNG, arch_of, case_of, chain, press
from helpers.stopped import assert_restart_is_bitwise, everywhere
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError

QUANTITIES = ("strain", "stress", "axial_force")


def assert_as_snapshots(folder, probe, bars):
    """Rows of steps with a snapshot have its fields, to the last bit; return the number of these."""
    result, found = open_result(folder), 0
    for i, step in enumerate(result.steps):
        for row in np.flatnonzero(result.history["step"] == step):
            for name in QUANTITIES:
                np.testing.assert_array_equal(
                    result.history[f"bar/{probe}/{name}"][row], result.field(name, i)[bars], err_msg=name
                )
            found += 1
    return found


@pytest.mark.parallel
def test_force_of_two_bars_along_their_path(comm, shared_tmp_path):
    """N = E A (l/L - 1), with the length from the height of the apex; on three ranks, one has no bar."""
    arch = arch_of(shared_tmp_path, comm, press(0.9))
    probes = {"probe": [{"name": "apex", "node_set": "apex"}], "bar_probe": [{"name": "both", "indices": [1, 0]}]}
    arch.update({"output": {**probes, "fields_every": 1}})
    history = run(arch, shared_tmp_path / "out", comm)
    height = history["probe/apex/position"][:, 0, 2]
    strain = np.hypot(1.0, height) / np.hypot(1.0, 0.1) - 1.0
    both = history["bar/both/axial_force"]
    assert both.shape == (5, 2) and both.min() < -100.0
    np.testing.assert_allclose(both, np.outer(ARCH_YOUNG * ARCH_AREA * strain, [1, 1]), rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(history["bar/both/stress"] * ARCH_AREA, both, rtol=1e-12)
    np.testing.assert_allclose(history["bar/both/strain"][:, 0], strain, rtol=1e-10, atol=1e-15)
    # 2 N sin is the load
    load = -2.0 * both[:, 0] * height / np.hypot(1.0, height)
    np.testing.assert_allclose(load, history["load_factor"] * -arch.load[0].force[2], rtol=1e-6, atol=1e-6)
    assert everywhere(comm, assert_as_snapshots, shared_tmp_path / "out", "both", [0, 1]) == 5


ROD = ("time.end=0.6", "output.fields_every=10")


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("every", [1, 5])
def test_rows_of_compiled_calls_have_the_forces_of_their_own_positions(every, comm, shared_tmp_path):
    """Bars beside each other on other ranks too; the numbers are those of a run on one rank."""
    case = Case.load("rod_impact", [*ROD, f"output.history_every={every}"])
    case.output.bar_probe = [{"name": "few", "indices": [17, 2, 7, 8]}, {"name": "middle", "nearest": [0.0, 0.0, 0.0]}]
    history = run(case, shared_tmp_path / "out", comm)
    found = everywhere(comm, assert_as_snapshots, shared_tmp_path / "out", "few", [2, 7, 8, 17])
    assert found == everywhere(comm, assert_as_rows_alone, case, shared_tmp_path, history) > 2
    plain = Case.load("rod_impact", [*ROD, f"output.history_every={every}"])
    without = run(plain, shared_tmp_path / "without", comm)  # whose calls do not end at rows
    for name in without:
        np.testing.assert_array_equal(without[name], history[name], err_msg=name)


def assert_as_rows_alone(case, folder, history):
    """Forces follow from the positions of snapshots; probes are those of a run on one rank, to the last bit."""
    alone = run(case, folder / "alone", MPI.COMM_SELF)
    for name in (name for name in alone if name.startswith("bar/")):
        np.testing.assert_array_equal(alone[name], history[name], err_msg=name)
    result, found = open_result(folder / "out"), 0
    (material,), (section,) = case.material.values(), case.section.values()
    ends = result.bars[[2, 7, 8, 17]]
    rest = np.linalg.norm(np.subtract(*result.positions(0)[ends.T]), axis=1)
    for i, step in enumerate(result.steps):
        length = np.linalg.norm(np.subtract(*result.positions(i)[ends.T]), axis=1)
        for row in np.flatnonzero(history["step"] == step):
            force = material.young_modulus * section.area * (length / rest - 1.0)
            largest = np.abs(history["bar/few/axial_force"]).max()
            np.testing.assert_allclose(history["bar/few/axial_force"][row], force, atol=1e-9 * largest)
            found += 1
    return found


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_a_bar_that_breaks_has_no_force_and_restarts_are_bitwise(integrator, comm, shared_tmp_path):
    time = {"integrator": integrator, "step": 2e-5, "end": 1.6e-3}
    initial = [{"node_set": "tip", "velocity": [30.0, 0.0, 0.0]}]
    probes = [{"name": "weak", "bars": "weak"}, {"name": "foot", "nearest": [0.0, 0.1, 0.0]}]
    output = {"fields_every": 7, "history_every": 2, "bar_probe": probes}
    case = chain(shared_tmp_path, comm, 5, [4], {"stress": 8e6}, time, initial={"on": initial}, output=output)
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 9, 50, allowed=1e-9 if comm.size > 1 else 0.0)
    broken, force = history["broken_bars"] > 0, history["bar/weak/axial_force"][:, 0]
    assert 0 < np.argmax(broken) < len(broken) - 5
    assert force[broken].tolist() == [0.0] * broken.sum() and 0.0 < force.max() < 1.05 * 8e6 * AREA
    strain = history["bar/weak/strain"][:, 0]  # that of the distance of its ends goes on
    np.testing.assert_allclose(force[~broken], YOUNG * AREA * strain[~broken], rtol=1e-9)
    assert strain[-1] > strain[np.argmax(broken)]
    everywhere(comm, assert_as_snapshots, shared_tmp_path / "whole", "weak", [4])
    assert everywhere(comm, assert_as_snapshots, shared_tmp_path / "whole", "foot", [0]) > 5


@pytest.mark.slow
@pytest.mark.parallel
def test_probes_of_bars_over_stages_and_load_cases(comm, shared_tmp_path):
    """A bar that is pulled, then let go: N is the load at rest, and swings about zero afterwards."""
    tables = {
        "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [1]}},
        "support": [{"node_set": "foot", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
        "output": {"bar_probe": [{"name": "bar", "indices": [0]}], "fields_every": 1},
    }
    points, bars = [[0.0, 0, 0], [1.0, 0, 0]], [[0, 1]]
    pull = {"load": [{"node_set": "tip", "force": [100.0, 0.0, 0.0]}]}
    stages = [
        {"name": "pull", "static": {"step": 0.5}, **pull},
        {"name": "free", "load": [], "time": {"integrator": "central_differences", "step": 1e-5, "end": 5e-4}},
    ]
    case = case_of(shared_tmp_path, comm, points, bars, **tables, stage=stages)
    history = run(case, shared_tmp_path / "stages", comm)
    still, force = history["stage"] == 0, history["bar/bar/axial_force"][:, 0]
    np.testing.assert_allclose(force[still], 100.0 * history["load_factor"][still], rtol=1e-8, atol=1e-8)
    swing = history["time"][~still] - history["time"][still][-1]
    frequency = np.sqrt(2.1e11 * 1e-4 / (0.5 * 7850.0 * 1e-4))  # half of the mass is at the tip
    np.testing.assert_allclose(force[~still], 100.0 * np.cos(frequency * swing), atol=3.0)

    loads = [{"name": name, "load": [{**pull["load"][0], "force": [f, 0, 0]}]} for name, f in (("a", 10), ("b", -20))]
    sums = [{"name": "both", "factors": {"a": 1.5, "b": 2.0}}]
    case = case_of(
        shared_tmp_path, comm, points, bars, **tables, static={"step": 1.0}, load_case=loads, combination=sums
    )
    history = run(case, shared_tmp_path / "cases", comm)
    ends = [history["bar/bar/axial_force"][history["stage"] == k][-1, 0] for k in np.unique(history["stage"])]
    np.testing.assert_allclose(ends[-3:], [10.0, -20.0, 15.0 - 40.0], rtol=1e-6)


@pytest.mark.parallel
def test_selections_of_bars(comm, shared_tmp_path):
    """A square with diagonals: the nearest of two bars at the same distance is the first; by group and by number."""
    points, bars = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]]
    case = case_of(shared_tmp_path, comm, points, bars, fixed=[0, 1], static={"step": 1.0})
    chosen = {"middle": {"nearest": [0.5, 0.5, 0]}, "right": {"nearest": [1.1, 0.5, 3]}, "two": {"indices": [5, 0]}}
    case.output.bar_probe = [{"name": name, **keys} for name, keys in chosen.items()]
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        found = {name: ids.tolist() for name, ids in simulation.model.probed_bars.ids.items()}
        simulation.run()
    assert found == {"middle": [4], "right": [1], "two": [0, 5]}
    attributes = everywhere(comm, lambda: open_result(shared_tmp_path / "out").attributes)
    assert attributes["probe_bars/two"] == [0, 5]


@pytest.mark.parametrize(
    ("keys", "texts"),
    [
        ({"indices": [6]}, ["output.bar_probe[0].indices: bar 6 does not exist; the mesh has bars 0 to 5"]),
        ({"bars": "leg"}, ["output.bar_probe[0].bars = 'leg'", "did you mean 'legs'?"]),
        ({"bars": {"field": "part", "value": 7}}, ["output.bar_probe[0].bars", "part"]),
    ],
)
def test_bars_that_are_not_in_the_mesh(keys, texts, tmp_path):
    from pfem_petsc import Truss

    points, bars = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]]
    data = {
        "mesh": Truss(points, bars, bar_groups={"legs": [1, 3]}),
        "material": {"steel": {"young_modulus": 2.1e11, "density": 7850.0}},
        "section": {"default": {"area": 1e-4, "material": "steel"}},
        "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-2},
        "output": {"bar_probe": [{"name": "it", **keys}]},
    }
    with pytest.raises(InputError) as refused:
        Simulation(Case(data), MPI.COMM_SELF, output=tmp_path, quiet=True)
    assert all(text in str(refused.value) for text in texts), refused.value


@pytest.mark.parametrize(
    ("probes", "texts"),
    [
        ([{"name": "it"}], ["output.bar_probe[0]", "exactly one of the keys bars, indices, nearest"]),
        ([{"name": "it", "indices": []}], ["output.bar_probe[0].indices", "at least one bar number"]),
        ([{"name": "it", "indices": [1, 1]}], ["a bar number is listed twice"]),
        ([{"name": "it", "indices": [1]}] * 2, ["output.bar_probe[1].name", "another bar probe has this name"]),
        ([{"name": "it", "indices": [1], "node_set": "a"}], ["unknown key"]),
    ],
)
def test_tables_that_select_no_bars(probes, texts):
    case = Case.load("rod_impact")
    with pytest.raises(InputError) as refused:
        case.output.bar_probe = probes
    assert all(text in str(refused.value) for text in texts), refused.value
