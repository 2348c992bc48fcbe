"""Failing runs: one message with step, node and reasons on all ranks, and earlier results are kept."""

import re

import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.output.result import open_result

COLLAPSE = r"step \d+, t = \S+ s: bar 19 between nodes 19 and 20 has gone through zero length, from 0\.05 m; .*use a"


def failing(comm, folder, *overrides):
    """Run rod_impact until it fails: the message, and the result on rank 0."""
    simulation = Simulation(Case.load("rod_impact", overrides), comm, output=folder, quiet=True)
    with pytest.raises(SimulationFailure) as failure:
        simulation.run()
    assert failure.value.exit_status == 3
    messages = comm.allgather(str(failure.value))
    assert messages == [messages[0]] * comm.size
    comm.Barrier()
    return messages[0], open_result(folder) if comm.rank == 0 else None


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "newmark", "chung_lee", "houbolt"])
def test_bar_driven_through_zero_length(scheme, comm, shared_tmp_path):
    """At three times the wave speed the last bar jumps over zero length within a step."""
    keys = ["initial.velocity=[3.0, 0.0, 0.0]", f"time.integrator={scheme}", "output.fields_every=1", "time.end=0.5"]
    message, result = failing(comm, shared_tmp_path / "it", *keys)
    assert re.search(COLLAPSE, message), message
    if result is not None:
        steps = result.history["step"]
        assert len(steps) >= 2
        assert np.array_equal(steps, np.arange(len(steps)))
        assert np.isfinite(result.history["kinetic_energy"]).all()
        assert int(message.split("step ")[1].split(",")[0]) == len(steps)  # the next one
        assert result.times[-1] == result.history["time"][-1]
        told, _, error = (shared_tmp_path / "it" / "log.txt").read_text().splitlines()[-3:]
        assert f"failed: {len(steps)} steps" in told and error.endswith(f"ERROR   error: {message}")


def test_a_slow_impact_is_not_called_too_strong(comm, shared_tmp_path):
    """Wilson's method with theta = 1.4 chatters until a bar is inverted, far below the speed that crushes bars."""
    keys = ["initial.velocity=[0.3, 0.0, 0.0]", "time.integrator=wilson", "time.end=2.0", "output.fields_every=0"]
    message, _ = failing(comm, shared_tmp_path / "it", *keys)
    assert "has gone through zero length" in message and "too strong" not in message
    assert "waves in it at 1.000 m/s" in message
    assert "nothing in the case is faster than 300.0 mm/s" in message
    assert "reduce time.step" in message and 'contact.treatment = "stick"' in message


def test_strong_but_bearable_impact_runs_on(comm, shared_tmp_path):
    """Half the wave speed: bars shorten to 0.4 of their length, and none is inverted."""
    case = Case.load("rod_impact", ["time.end=0.6", "output.fields_every=10"])
    Simulation(case, comm, output=shared_tmp_path / "it", quiet=True).run()
    if comm.rank == 0:
        result = open_result(shared_tmp_path / "it")
        assert min(result.field("strain", i).min() for i in range(len(result.times))) < -0.5


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["energy_momentum", "central_differences"])
def test_truss_crushed_between_walls(scheme, comm, shared_tmp_path):
    """Two walls close in on a tetrahedron until there is no room between them, or a bar has collapsed before."""
    import h5py

    if comm.rank == 0:
        with h5py.File(shared_tmp_path / "mesh.h5", "w") as file:
            file["points"] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, 0.3, 0.8]]
            file["bars"] = [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1)]
    comm.Barrier()
    walls = [("floor", -0.01, 1.0), ("roof", 0.81, -1.0)]
    data = {
        "mesh": {"file": "mesh.h5"},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "wall": [
            {
                "name": name,
                "type": "plane",
                "point": [0.0, 0.0, z],
                "normal": [0.0, 0.0, n],
                "velocity": [0.0, 0.0, 4 * n],
            }
            for name, z, n in walls
        ],
        "time": {"integrator": scheme, "step": 2e-4 if scheme == "central_differences" else 1e-2, "end": 1.0},
    }
    case = Case.from_dict(data, source="crush.toml", folder=shared_tmp_path)
    simulation = Simulation(case, comm, output=shared_tmp_path / "it", quiet=True)
    with pytest.raises(SimulationFailure, match="they are infeasible together|collapsed|zero length") as failure:
        simulation.run()
    assert 0.01 < simulation.state.time < 0.105
    assert comm.allgather(str(failure.value)) == [str(failure.value)] * comm.size


@pytest.mark.parallel
def test_no_convergence(comm, shared_tmp_path):
    """One Newton iteration for a nonlinear step and a tolerance below rounding."""
    keys = [
        "time.integrator=newmark",
        "solver.max_newton=1",
        "solver.rtol=1e-16",
        "time.step=0.2",
        "solver.guard=false",
    ]
    message, result = failing(comm, shared_tmp_path / "it", *keys, "initial.velocity=[0.95, 0.3, 0.0]")
    for part in (
        "step 2, t = ",
        "no convergence after 1 Newton iterations",
        "the limit of Newton iterations was reached [DIVERGED_MAX_IT]",
        "residual ",
        "required ",
        "worst at node ",
        "Reduce time.step",
    ):
        assert part in message
    # the residual of the worst node is an error, not what the wall bears
    total = float(message.split("residual ")[1].split(" N")[0])
    worst = float(message.split("worst at node ")[1].split("(")[1].split(" N")[0])
    assert 0.0 < worst <= total * (1.0 + 1e-2)
    if result is not None:
        assert result.history["step"].tolist() == [0, 1]


@pytest.mark.slow
def test_step_above_the_limit_of_the_deformed_model_is_told(comm, shared_tmp_path):
    """A green-strain rod stiffens as it is stretched: the limit at rest no longer holds, and the run blows up."""
    keys = ["material.default.strain=green", "initial.velocity=[0.0, 0.0, 0.0]", "time.step=0.0495", "time.end=60.0"]
    keys += ["support=[{node_set='base', fix='xyz'}]", "node_set.base.nearest=[0.0, 0.0, 0.0]", "wall=[]"]
    keys += ["load=[{node_set='tip', force=[1.5, 0.0, 0.0]}]"]
    message, _ = failing(comm, shared_tmp_path / "it", *keys)
    assert "step" in message
    assert "reduce time.step" in message.lower()
