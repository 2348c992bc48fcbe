"""Forces that a function of time and state returns in each step."""

import numpy as np
import pytest
from helpers.kills import differences
from helpers.runs import run
from helpers.stopped import everywhere
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError, SimulationFailure

SCHEMES = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura", "newmark", "wilson", "houbolt"]
SCHEMES += ["generalized_alpha", "energy_momentum"]
EXACT = ("central_differences", "newmark", "generalized_alpha", "energy_momentum")  # no dissipation of their own
ROWS = [[0.0, 0.0], [0.3, 1.0], [0.5, -1.0], [1.0, 0.5]]
FORCE = np.array([3e-3, -2e-3, 1e-3])


def rod(scheme="newmark", load=(), **tables):
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
            "node_set": {"end": {"group": "end"}, "start": {"group": "start"}},
            "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "support": [{"node_set": "start", "fix": "xyz"}],
            "load": list(load),
            "time": {"integrator": scheme, "step": 0.02, "end": 1.0},
            "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
            "solver": {"linear": "cg", "rtol": 1e-12},
            **tables,
        },
        name="rod",
    )


def on_end(t, state):
    force = np.zeros_like(state.position)
    force[state.node_sets["end"]] = FORCE * np.interp(t, *np.transpose(ROWS))
    return force


def finish(case, comm, folder, function=on_end, **options):
    with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
        simulation.external_force(function)
        simulation.run()
    return open_result(folder).history


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_force_of_time_is_a_table(scheme, tmp_path):
    """The same run to the last bit, energies and reactions included; but for compiled steps, which round otherwise."""
    table = rod(scheme, [{"node_set": "end", "force": FORCE.tolist(), "table": ROWS}])
    run(table, tmp_path / "table", MPI.COMM_SELF)
    finish(rod(scheme), MPI.COMM_SELF, tmp_path / "function")
    first, second = (open_result(tmp_path / name).history for name in ("table", "function"))
    largest = np.abs(second["external_work"]).max()
    for name in first:
        rounding = 1e-11 * max(largest, np.abs(first[name]).max()) if scheme == "central_differences" else 0.0
        np.testing.assert_allclose(first[name], second[name], rtol=0.0, atol=rounding, err_msg=name)
    assert largest > 1e-7


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_on_ranks(scheme, comm, shared_tmp_path):
    """Each rank gives the forces on its nodes, which it knows by their numbers."""

    def last(t, state):
        return np.outer((state.nodes == 4) * np.interp(t, *np.transpose(ROWS)), FORCE)

    history = finish(rod(scheme), comm, shared_tmp_path / "out", last)
    alone = run(
        rod(scheme, [{"node_set": "end", "force": FORCE.tolist(), "table": ROWS}]),
        shared_tmp_path / str(comm.rank),
        MPI.COMM_SELF,
    )
    np.testing.assert_allclose(history["probe/end/position"], alone["probe/end/position"], rtol=0, atol=1e-13)
    np.testing.assert_allclose(history["external_work"], alone["external_work"], rtol=0, atol=1e-14)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_spring_to_the_ground(scheme, tmp_path):
    """A force -k x - c v on a free bar moves it as an oscillator does; what the force does is external work."""
    k, c, mass, h = 4.0, 0.4, 1.0, 0.01

    def spring(t, state):
        x = state.position - rest[state.nodes]
        return -0.5 * (k * x + c * state.velocity)

    rest = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    parameters = {"beta": 0.25, "gamma": 0.5} if scheme == "newmark" else {}
    case = rod(
        scheme,
        support=[],
        mesh={"generator": "rod", "length": 1.0, "elements": 1},
        initial={"velocity": [0.0, 0.1, 0.0]},
    )
    data = case.to_dict()
    data["time"] = {"integrator": scheme, "step": h, "end": 2.0, **parameters}
    history = finish(Case.from_dict(data), MPI.COMM_SELF, tmp_path / "out", spring)
    t, decay = history["time"], 0.5 * c / mass
    w = np.sqrt(k / mass - decay**2)
    exact = 0.1 / w * np.exp(-decay * t) * np.sin(w * t)
    # schemes of first order have their own error
    most = 0.03 if scheme == "souza_moura" else 4e-3
    assert np.abs(history["probe/end/position"][:, 0, 1] - exact).max() < most * np.abs(exact).max()
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"][0]
    lost = history["kinetic_energy"][-1] - history["kinetic_energy"][0]
    assert history["external_work"][-1] == pytest.approx(lost, rel=5e-3 if scheme in EXACT else 0.1)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "generalized_alpha"])
def test_restart_is_bitwise_with_the_function_and_warns_without(scheme, comm, shared_tmp_path, capfd):
    folders = shared_tmp_path / "whole", shared_tmp_path / "parts"

    def pull(t, state):
        return 1e-3 * np.sin(30.0 * t) * state.position - 1e-2 * state.velocity

    def case(end):
        return rod(scheme, time={"integrator": scheme, "step": 0.02, "end": end}, output={"checkpoint_every": 10})

    finish(case(1.0), comm, folders[0], pull)
    finish(case(0.5), comm, folders[1], pull)
    finish(case(1.0), comm, folders[1], pull, restart=True)
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}
    assert "function" not in capfd.readouterr().err
    with Simulation(case(1.2), comm, output=folders[1], quiet=True, restart=True) as simulation:
        simulation.run()
    error = capfd.readouterr().err
    assert comm.rank or "the run had 1 function for forces, and this one has 0" in error


WRONG = {
    "raises": (lambda t, state: 1 / 0 if t > 0.5 else 0.0 * state.v, "raised ZeroDivisionError: division by zero"),
    "shape": (lambda t, state: np.zeros(3), r"returned an array \(3,\): expected"),
    "not finite": (lambda t, state: state.v * np.nan, "returned a force on node [0-9]+ that is not finite"),
}


@pytest.mark.parametrize("function, told", WRONG.values(), ids=WRONG)
def test_wrong_functions(tmp_path, function, told):
    with pytest.raises(SimulationFailure, match=r"step \d+, t = .*external_force: the function " + told):
        finish(rod(), MPI.COMM_SELF, tmp_path / "out", function)


@pytest.mark.parallel
def test_a_function_that_fails_on_one_rank_ends_all(comm, shared_tmp_path):
    def fails(t, state):
        if t > 0.5 and comm.rank == comm.size - 1:
            raise ValueError("no such force")
        return 0.0 * state.v

    with pytest.raises(SimulationFailure, match="raised ValueError: no such force"):
        finish(rod("central_differences"), comm, shared_tmp_path / "out", fails)


@pytest.mark.slow
def test_refusals(tmp_path):
    static = rod().to_dict()
    del static["time"]
    static = Case.from_dict({**static, "static": {"method": "newton"}})
    with (
        Simulation(static, MPI.COMM_SELF, output=tmp_path / "s", quiet=True) as simulation,
        pytest.raises(InputError, match=r"this case has no \[time\]"),
    ):
        simulation.external_force(on_end)
    wall = {"name": "w", "type": "plane", "point": [9.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "end"}
    massless = rod(wall=[wall], contact={"treatment": "mass_redistribution"})
    with (
        Simulation(massless, MPI.COMM_SELF, output=tmp_path / "m", quiet=True) as simulation,
        pytest.raises(InputError, match="leaves nodes without mass"),
    ):
        simulation.external_force(on_end)
    with Simulation(rod(), MPI.COMM_SELF, output=tmp_path / "t", quiet=True) as simulation:
        with pytest.raises(InputError, match="is not a function"):
            simulation.external_force(1.0)
        simulation.start()
        with pytest.raises(InputError, match="the run has started"):
            simulation.external_force(on_end)


@pytest.mark.slow
def test_in_stages(tmp_path):
    """The static stage is without the force, the one in motion begins with it; its time is that of the stage."""
    stages = [
        {"name": "hold", "static": {"step": 0.5}},
        {"name": "move", "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 0.02, "end": 1.0}},
    ]
    data = rod().to_dict()
    del data["time"]
    history = finish(Case.from_dict({**data, "stage": stages}), MPI.COMM_SELF, tmp_path / "out")
    motion = rod("newmark", time=stages[1]["time"])
    alone = finish(motion, MPI.COMM_SELF, tmp_path / "alone")
    np.testing.assert_allclose(history["probe/end/position"][3:], alone["probe/end/position"][1:], atol=1e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()
