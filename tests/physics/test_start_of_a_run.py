"""The balance at the start: reactions, accelerations, nodes on walls."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import SCHEMES, case, run, unexplained


@pytest.mark.parametrize("integrator", ["newmark", "houbolt", "chung_lee"])
def test_reaction_of_a_consistent_mass_at_the_start(integrator, shared_tmp_path):
    """A bar of 1 kg let fall along itself: M a of its free node is (g m/2) (m/6)/(m/3) = g m/4 at the fixed one."""
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=10,
            mass="consistent",
            node_set={"top": {"nearest": [0.0, 0.0, 0.0]}},
            support=[{"node_set": "top", "fix": "xyz"}],
            gravity={"acceleration": [10.0, 0.0, 0.0]},
            output={"fields_every": 0, "probe": [{"name": "top", "node_set": "top"}]},
        ),
        shared_tmp_path,
    )
    assert history["probe/top/reaction"][0, 0, 0] == pytest.approx(-2.5, rel=1e-12)
    assert unexplained(history) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["chung_lee", "hulbert_chung", "generalized_alpha", "energy_momentum", "wilson"])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_recorded_accelerations_are_of_second_order(integrator, mass, shared_tmp_path):
    """The end of a bar swings along it: a = -w^2 u, with w^2 = (E A/L)/(rho A L/2), or /3 with consistent mass."""
    errors = []
    square = 1e4 / (0.5 if mass == "lumped" else 1.0 / 3.0)
    for steps in (40, 80):
        history = run(
            case(
                integrator,
                step=0.02 / steps,
                steps=steps,
                mass=mass,
                node_set={"root": {"nearest": [0.0, 0.0, 0.0]}, "end": {"nearest": [1.0, 0.0, 0.0]}},
                support=[{"node_set": "root", "fix": "xyz"}],
                initial={"on": [{"node_set": "end", "velocity": [1.0, 0.0, 0.0]}]},
                output={"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
            ),
            shared_tmp_path / str(steps),
        )
        w = np.sqrt(square)
        exact = -w * np.sin(w * history["time"])
        errors.append(np.abs(history["probe/end/acceleration"][:, 0, 0] - exact).max() / w)
    assert errors[0] < 0.1
    assert np.log2(errors[0] / errors[1]) > 1.8


@pytest.mark.parametrize("integrator", SCHEMES)
def test_damped_nodes_that_start_on_a_wall(integrator, shared_tmp_path):
    """An impact in the first instant: what walls stop is damped as if it were stopped already."""
    history = run(
        case(
            integrator,
            step=1e-4,
            steps=40,
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            material={"default": {"young_modulus": 1e4, "density": 1.0, "damping": 200.0}},
            walls=[{"point": [1.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}],
            initial={"velocity": [0.5, 0.0, 0.0]},
        ),
        shared_tmp_path,
    )
    assert history["active_contacts"][1] == 1
    start = history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * start
    stopped = start / 8.0  # the kinetic energy of the node; schemes that let go of it strike it again
    chatters = integrator in ("chung_lee", "noh_bathe", "houbolt", "generalized_alpha", "energy_momentum")
    assert history["impact_dissipation"][1] == pytest.approx(stopped, rel=1e-9)
    assert chatters or history["impact_dissipation"][-1] == pytest.approx(stopped, rel=1e-9)
    assert (np.diff(history["damping_dissipation"]) >= 0.0).all()
    assert unexplained(history) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("treatment", ["scheme", "stick", "mass_redistribution", "conserving"])
@pytest.mark.parametrize("integrator", ["newmark", "houbolt", "energy_momentum"])
def test_start_on_a_wall_is_an_impact_at_the_start(integrator, treatment, shared_tmp_path):
    """A velocity into the wall that nodes start on does what it does at a gap that is next to nothing."""
    found = []
    for gap in (0.0, 1e-10):
        asked = case(
            integrator,
            step=2e-3,
            steps=15,
            treatment=treatment,
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            node_set={"tip": {"group": "end"}},
            walls=[{"point": [1.0 + gap, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "tip"}],
            initial={"velocity": [0.5, 0.0, 0.0]},
            solver={"rtol": 1e-12},
        )
        found.append(run(asked, shared_tmp_path / str(gap)))
    at_once, later = found
    start = at_once["kinetic_energy"][0]
    assert at_once["active_contacts"][1] == 1
    for name in ("kinetic_energy", "elastic_energy", "impact_dissipation", "numerical_dissipation"):
        np.testing.assert_allclose(at_once[name], later[name], atol=1e-5 * start)
    assert np.abs(at_once["energy_imbalance"]).max() < 1e-9 * start
    assert unexplained(at_once) < 1e-9
