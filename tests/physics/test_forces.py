"""Loads over time, moving supports, damping and bisection of steps, against closed forms."""

import numpy as np
import pytest
from helpers.runs import imbalance, run

from pfem_petsc import Case

pytestmark = pytest.mark.parallel

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


@pytest.mark.parametrize("integrator, order", [("central_differences", 1e-4), ("houbolt", 3e-3), ("chung_lee", 2e-3)])
def test_damping(integrator, order, shared_tmp_path, comm):
    """Mass-proportional damping slows a flying rod down as exp(-c t/rho), whatever its mesh."""
    decay = 0.5
    material = {"m": {"young_modulus": 1.0, "density": 1.0, "damping": decay}}
    case = rod(integrator, material=material, initial={"velocity": [0.0, 0.0, 1.0]}, time={"step": 0.01})
    history = run(case, shared_tmp_path)
    assert history["momentum"][-1, 2] == pytest.approx(np.exp(-decay * 4.0), rel=order)
    lost = history["damping_dissipation"][-1]
    assert lost == pytest.approx(0.5 * (1.0 - np.exp(-2 * decay * 4.0)), rel=0.02)
    assert imbalance(history) < 1e-10


def test_halving(shared_tmp_path, comm):
    """A step that Newton's method cannot make in the iterations allowed is made in parts, which grow back."""
    overrides = [
        "time.integrator=newmark",
        "time.step=2e-3",
        "time.end=0.02",
        "solver.max_newton=2",
        "solver.rtol=1e-12",
    ]
    case = Case.load("tumbling_lattice", [*overrides, "output.fields_every=0"])
    history = run(case, shared_tmp_path)
    assert history["step_size"].min() < 2e-3
    assert history["time"][-1] == pytest.approx(0.02)
    assert np.diff(history["time"]) == pytest.approx(np.full(10, 2e-3))
    assert imbalance(history) < 1e-8
    # two iterations or fewer a part, and more than one part where the step was halved
    assert history["newton_iterations"].max() > 2
    if comm.rank == 0:
        assert "bisecting the step" in (shared_tmp_path / "log.txt").read_text()
