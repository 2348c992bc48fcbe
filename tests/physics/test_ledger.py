"""The effect of contact on energy: impact, friction, walls that move or have mass."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import GRAVITY, SCHEMES, case, floor, run, unexplained

from pfem_petsc.columns import LOST, STORED, SUPPLIED


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("phase", [0.0, 0.31, 0.77])
def test_impact_of_a_plank(integrator, phase, shared_tmp_path):
    """A rod that falls flat loses m (v0^2 + 2 g d)/2 at the floor, with any scheme and wherever in a step it lands."""
    step, drop = 1e-3, 0.01
    speed = drop / ((10 + phase) * step) - 0.5 * GRAVITY * (10 + phase) * step  # lands after 10 + phase steps
    history = run(
        case(
            integrator,
            step=step,
            steps=14,
            walls=[floor(point=[0.0, 0.0, -drop])],
            gravity={"acceleration": [0.0, 0.0, -GRAVITY]},
            initial={"velocity": [0.0, 0.0, -speed]},
        ),
        shared_tmp_path,
    )
    first = np.flatnonzero(history["impact_dissipation"])[0]
    assert history["impact_dissipation"][first] == pytest.approx(0.5 * (speed**2 + 2 * GRAVITY * drop), rel=1e-9)
    assert not history["contact_work"].any()
    assert unexplained(history) < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-10


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "energy_momentum"])
def test_nothing_is_lost_before_the_first_row(integrator, shared_tmp_path):
    """A rod that starts on a wall, moving into it, has its kinetic energy in the first row."""
    options = {"walls": [floor()], "initial": {"velocity": [0.0, 0.0, -2.0]}}
    history = run(case(integrator, step=1e-3, steps=5, **options), shared_tmp_path)
    assert history["kinetic_energy"][0] == pytest.approx(2.0, rel=1e-14)
    assert history["impact_dissipation"][:2] == pytest.approx([0.0, 2.0], rel=1e-14)
    assert unexplained(history) < 1e-12


@pytest.mark.slow
def test_a_belt_works_and_rubs(shared_tmp_path):
    """A belt of velocity V under a rod at rest does the work F V t; friction takes what the rod does not get of it."""
    belt = floor(friction=0.2, velocity=[0.0, 5.0, 0.0])
    time, push = 0.04, 0.2 * GRAVITY
    history = run(
        case("central_differences", step=1e-4, steps=400, walls=[belt], gravity={"acceleration": [0.0, 0.0, -GRAVITY]}),
        shared_tmp_path,
    )
    assert history["contact_work"][-1] == pytest.approx(push * 5.0 * time, rel=1e-3)
    gained = 0.5 * (push * time) ** 2
    assert history["friction_dissipation"][-1] == pytest.approx(push * 5.0 * time - gained, rel=1e-3)
    assert history["kinetic_energy"][-1] == pytest.approx(gained, rel=1e-3)


@pytest.mark.parametrize("integrator", SCHEMES)
def test_walls_with_mass_are_in_the_balance(integrator, shared_tmp_path):
    """A wall of mass M falls onto a rod at rest: impact takes that of the reduced mass, and the whole is in balance."""
    heavy, speed, drop = 3.0, 2.0, 0.0231
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=20,
            walls=[
                floor(
                    normal=[0.0, 0.0, -1.0],
                    point=[0.0, 0.0, drop],
                    mass=heavy,
                    gravity=True,
                    velocity=[0.0, 0.0, -speed],
                )
            ],
            gravity={"acceleration": [0.0, 0.0, -GRAVITY]},
        ),
        shared_tmp_path,
    )
    first = np.flatnonzero(history["impact_dissipation"])[0]
    assert history["impact_dissipation"][first] == pytest.approx(0.5 * 0.75 * speed**2, rel=1e-9)
    assert history["wall_kinetic_energy"] == pytest.approx(
        0.5 * heavy * (history["wall/wall0/velocity"] ** 2).sum(axis=1), rel=1e-13
    )
    fall = history["wall/wall0/position"][:, 2] - history["wall/wall0/position"][0, 2]
    truss = history["centre_of_mass"][:, 2] - history["centre_of_mass"][0, 2]
    assert history["external_work"] == pytest.approx(-GRAVITY * (heavy * fall + truss), rel=1e-9, abs=1e-9)
    assert not history["contact_work"].any()
    balance = sum(history[name] for name in (*STORED, *LOST)) - sum(history[name] for name in SUPPLIED)
    assert np.abs(balance - balance[0]).max() < 1e-9 * history["wall_kinetic_energy"].max()
    momentum = history["momentum"] + heavy * history["wall/wall0/velocity"]
    weight = np.outer(history["time"], [0.0, 0.0, -GRAVITY * (1 + heavy)])
    assert np.abs(momentum - momentum[0] - weight).max() < 1e-8 * heavy * speed


@pytest.mark.slow
@pytest.mark.parametrize("treatment", ["scheme", "stick", "conserving"])
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "houbolt", "energy_momentum"])
def test_pairs_meet(integrator, treatment, shared_tmp_path):
    """Two rods of one bar meet end on: impact takes mu s^2/2 of their nodes' reduced mass, and pairs keep momentum."""
    if treatment == "conserving" and integrator == "central_differences":
        pytest.skip("the scheme does not go with the treatment")
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=30,
            treatment=treatment,
            mesh={"generator": "two_rods", "length": 1.0, "elements": 1, "gap": 0.0113},
            node_set={
                "first": {"group": "first_end"},
                "second": {"group": "second_start"},
                "left": {"box": [[-1, -1, -1], [1.001, 1, 1]]},
            },
            contact_pair=[{"name": "faces", "first": "first", "second": "second", "direction": [1.0, 0.0, 0.0]}],
            initial={"on": [{"node_set": "left", "velocity": [1.0, 0.0, 0.0]}]},
        ),
        shared_tmp_path,
    )
    assert np.abs(history["momentum"] - [1.0, 0.0, 0.0]).max() < 1e-9
    lost = history["impact_dissipation"]
    if treatment == "conserving":
        assert not lost.any()
        assert np.abs(history["pair/faces/jump_impulse"]).max() > 0.0
    else:
        assert lost[np.flatnonzero(lost)[0]] == pytest.approx(0.5 * 0.25, rel=1e-9)
    assert history["pair/faces/impulse"][-1, 0] > 0.1
    assert np.abs(history["energy_imbalance"]).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("integrator", ["wilson", "hulbert_chung", "generalized_alpha", "energy_momentum"])
def test_damping_only_takes(integrator, mass, shared_tmp_path):
    """Where the balance is not that of a step's ends its velocity may point against the step: after impacts at
    t + theta h."""
    step = 0.05 if integrator == "hulbert_chung" else 0.5
    material = {"default": {"young_modulus": 100.0, "density": 1.0, "damping": 0.05}}
    mesh = {"generator": "rod", "length": 10.0, "elements": 10}
    wall = {"point": [10.2, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    initial = {"velocity": [0.3, 0.0, 0.0]}
    extra = {"initial": initial, "mesh": mesh, "walls": [wall], "mass": mass, "material": material}
    steps = 60 if step == 0.5 else 400
    history = run(case(integrator, step=step, steps=steps, **extra), shared_tmp_path)
    start = history["kinetic_energy"][0]
    assert history["active_contacts"].max() > 0
    assert (np.diff(history["damping_dissipation"]) >= 0.0).all()
    assert history["damping_dissipation"][-1] > 0.05 * start
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * start


def test_damping_of_backward_differences_only_takes(shared_tmp_path):
    """A wall that turns a bar back within one large step: the velocities at its ends then point against the step."""
    wall = {"point": [10.2, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    material = {"default": {"young_modulus": 100.0, "density": 1.0, "damping": 0.05}}
    mesh = {"generator": "rod", "length": 10.0, "elements": 1}
    initial = {"velocity": [0.3, 0.0, 0.0]}
    table = case("houbolt", step=5.0, steps=20, mesh=mesh, walls=[wall], material=material, initial=initial)
    history = run(table, shared_tmp_path)
    assert (np.diff(history["damping_dissipation"]) > 0.0).all()
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * history["kinetic_energy"][0]
