"""Loads over time, moving supports, damping and bisection of steps, against closed forms."""

import numpy as np
import pytest
from helpers.runs import imbalance, run, unexplained

from pfem_petsc import Case

ROD = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 8},
    "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
    "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
    "section": {"s": {"area": 1.0, "material": "m"}},
    "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
}


def rod(integrator, **tables):
    time = {"integrator": integrator, "step": 0.02, "end": 4.0, **tables.pop("time", {})}
    return Case.from_dict(ROD | tables | {"time": time})


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "generalized_alpha", "energy_momentum"])
def test_impulse_of_a_load(integrator, shared_tmp_path, comm):
    """Momentum is the integral of the force, here a triangle over time."""
    load = {"node_set": "end", "force": [0.0, 3e-3, 0.0], "table": [[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]]}
    history = run(rod(integrator, load=[load], solver={"rtol": 1e-12}), shared_tmp_path)
    assert history["momentum"][-1] == pytest.approx([0.0, 3e-3, 0.0], abs=2e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


PULLS = {
    "velocity": {"velocity": [0.005, 0.0, 0.0]},
    "linear": {"motion": [[0.0, 0.0, 0.0, 0.0], [5.0, 0.025, 0.0, 0.0]], "interpolation": "linear"},
}


@pytest.mark.parallel
@pytest.mark.parametrize("pull", PULLS.values(), ids=PULLS)
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "chung_lee"])
def test_moved_support(integrator, pull, shared_tmp_path, comm):
    """A support pulled at constant speed: the end follows exactly, and its work is what the rod has gained."""
    supports = [
        {"node_set": "all", "fix": "yz"},
        {"node_set": "start", "fix": "x"},
        {"node_set": "end", "fix": "x", **pull},
    ]
    history = run(rod(integrator, support=supports), shared_tmp_path)
    assert history["probe/end/position"][:, 0, 0] == pytest.approx(1.0 + 0.005 * history["time"], abs=1e-14)
    gained = history["kinetic_energy"] + history["elastic_energy"] + history["numerical_dissipation"]
    assert history["external_work"][-1] == pytest.approx(gained[-1] - gained[0], rel=1e-9)
    assert history["external_work"][-1] > 1e-4
    # after a whole number of wave transits the mean tension is that of the mean strain
    assert np.mean(history["probe/end/reaction"][100:, 0, 0]) == pytest.approx(0.015, rel=0.1)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["newmark", "houbolt"])
def test_halving(integrator, shared_tmp_path, comm):
    """A step that Newton's method cannot make in the iterations allowed is made in parts, which grow back.

    Each part starts from the temperature at its start; Houbolt's method and the rule of the impulses forget their past.
    """
    overrides = [f"time.integrator={integrator}", "time.step=2e-3", "time.end=0.02", "output.fields_every=0"]
    overrides += ["solver.max_newton=2", "solver.rtol=1e-12", "temperature=[{table=[[0.0, 0.0], [0.02, 50.0]]}]"]
    data = Case.load("tumbling_lattice", overrides).to_dict()
    for material in data["material"].values():
        material |= {"thermal_expansion": 1e-5, "damping": 20.0}
    history = run(Case.from_dict(data), shared_tmp_path)
    assert history["step_size"].min() < 2e-3
    assert history["time"][-1] == pytest.approx(0.02)
    assert np.diff(history["time"]) == pytest.approx(np.full(10, 2e-3))
    assert imbalance(history) < 1e-8
    assert np.abs(history["thermal_work"]).max() > 0.0 < np.abs(history["damping_impulse"]).max()
    assert unexplained(history) < 1e-8
    # two iterations or fewer a part, and more than one part where the step was halved
    assert history["newton_iterations"].max() > 2
    if comm.rank == 0:
        assert "bisecting the step" in (shared_tmp_path / "log.txt").read_text()
