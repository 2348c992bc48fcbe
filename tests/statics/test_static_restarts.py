"""Static analyses continued from checkpoints: the same to the last bit, events and branches included."""

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result

DOME = "static.branch_at=[2]", "static.step=0.05", "static.max_points=17", "output.checkpoint_every=1"
NET = "mesh.cells=[4, 4]", "static.step=0.25", "material.rope.young_modulus=1e7", "output.checkpoint_every=1"
FLOOR = {"name": "floor", "type": "plane", "point": [0.0, 0.0, -2.3], "normal": [0.0, 0.0, 1.0]}
SLIDERS = {
    "mesh": {"generator": "rod", "length": 3.0, "elements": 3},
    "node_set": {"all": {"all": True}, "sliders": {"indices": [0, 1, 2]}, "hand": {"indices": [3]}},
    "material": {"rope": {"young_modulus": 1e8, "density": 1000.0}},
    "section": {"all": {"area": 1e-4, "material": "rope"}},
    "support": [
        {"node_set": "all", "fix": "y"},
        {"node_set": "hand", "fix": "xz", "interpolation": "linear"}
        | {"motion": [[0.0, 0, 0, 0], [0.25, 0.004, 0, 0], [0.75, -0.003, 0, 0], [1.0, 0.001, 0, 0]]},
    ],
    "load": [{"node_set": "sliders", "force": [0.0, 0.0, -15.0], "table": [[0.0, 1.0], [1.0, 1.0]]}],
    "wall": [FLOOR | {"point": [0.0, 0.0, 0.0], "node_set": "sliders", "friction": 0.4}],
    "static": {"step": 0.05},
    "solver": {"linear": "cg", "rtol": 1e-12},  # MUMPS on several ranks repeats to rounding alone
    "output": {"fields_every": 3, "checkpoint_every": 7},
}
STOPPED = {"increments": 4, "slip": 10, "relaxation": 2, "relaxation alone": 2, "branch": 12, "at the branch": 13}
"""The step at which each is stopped."""


def case_of(name):
    if name == "slip":
        return Case.from_dict(SLIDERS)
    if name.startswith("relaxation"):
        newton = f"static.newton={str(name == 'relaxation').lower()}"
        return Case.from_dict(Case.load("hanging_net", [*NET, newton]).to_dict() | {"wall": [FLOOR]})
    if name.endswith("branch"):
        return Case.load("dome_16", [*DOME, "output.fields_every=7"])
    data = Case.load("von_mises", ["output.checkpoint_every=3"]).to_dict()
    if name == "increments":
        data |= {"static": {"step": 0.03, "max_step": 0.1, "end": 0.3}, "solver": {"linear": "cg"}}
    else:
        del data["static"]["constraint"]
        data["static"]["method"] = "displacement"
    return Case.from_dict(data)


def contents(path):
    """Every dataset of a result file but the text and the attributes of the run."""
    found = {}
    with h5py.File(path / "result.vtkhdf") as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return {name: values for name, values in found.items() if not name.startswith("case/")}


def run_until(case, comm, folder, step):
    """Run up to a step, and stop without a checkpoint of it beyond those that the case asks for."""
    simulation = Simulation(case, comm, output=folder, quiet=True)
    for made in simulation:
        if made.step == step:
            break
    simulation.close()


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("name", "at"), [*STOPPED.items(), ("displacement", 9)])
def test_restart_is_bitwise(name, at, comm, shared_tmp_path):
    """In the middle of increments, of slip, of a path before and at the point where it leaves for a branch."""
    folder, case = shared_tmp_path, case_of(name)
    Simulation(case, comm, output=folder / "whole", quiet=True).run()
    run_until(case, comm, folder / "parts", at)
    Simulation(case, comm, output=folder / "parts", restart=True, quiet=True).run()
    if comm.rank == 0:
        whole, parts = contents(folder / "whole"), contents(folder / "parts")
        assert whole.keys() == parts.keys() and whole["history/step"][-1] > at
        for column, values in whole.items():
            # ranks may get other nodes in the next run of a process: sums have another order
            exact = comm.size == 1 or name in ("branch", "at the branch", "displacement")
            if exact or values.dtype.kind not in "f":
                assert not exact or np.array_equal(parts[column], values), column
            else:
                atol = 1e-9 * max(np.abs(values).max(initial=0.0), 1e-3)
                np.testing.assert_allclose(parts[column], values, rtol=0.0, atol=atol, err_msg=column)


@pytest.mark.slow
def test_events_after_the_checkpoint_are_cut_off(tmp_path):
    """A run that was killed after more events than its checkpoint has seen finds them once."""
    case = Case.load("von_mises", ["output.checkpoint_every=5", "output.history_every=3"])
    simulation = Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", quiet=True)
    for made in simulation:
        if made.step == 9:
            break
    simulation.close()  # the event before point 7 is in the file, the checkpoint is that of step 5
    assert open_result(tmp_path / "a").history["event/step"].tolist() == [7]
    Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", restart=True, quiet=True).run()
    history = open_result(tmp_path / "a").history
    assert history["event/kind"].tolist() == ["limit", "limit"]
    assert history["event/step"].tolist() == [7, 18]


@pytest.mark.slow
def test_restart_of_a_finished_path_ends_at_once(tmp_path):
    case = Case.load("von_mises", ["output.checkpoint_every=5"])
    Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", quiet=True).run()
    before = contents(tmp_path / "a")
    simulation = Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", restart=True, quiet=True)
    assert simulation.run() == 0
    after = contents(tmp_path / "a")
    for column, values in before.items():
        np.testing.assert_array_equal(after[column], values, err_msg=column)


@pytest.mark.slow
def test_damaged_event_is_found(tmp_path):
    """Events have checksums as rows of the history have."""
    from pfem_petsc.output.integrity import examine

    Simulation(Case.load("von_mises"), MPI.COMM_SELF, output=tmp_path / "a", quiet=True).run()
    path = tmp_path / "a" / "result.vtkhdf"
    assert examine(path, deep=True) == []
    with h5py.File(path, "r+") as file:
        file["event/load_factor"][1] += 1e-9
    assert any("event" in line for line in examine(path, deep=True))
