"""What contact does to energy and momentum: impact, friction, walls that move or have a mass, impulses and jumps."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.energies import LOST, STORED, SUPPLIED

SCHEMES = [
    "central_differences",
    "chung_lee",
    "hulbert_chung",
    "newmark",
    "houbolt",
    "wilson",
    "generalized_alpha",
    "energy_momentum",
]
GRAVITY = 9.81
MIDDLE = [[0.2, -1.0, -1.0], [0.3, 1.0, 1.0]]


def case(integrator, *, step, steps, treatment="scheme", mass="lumped", mesh=None, walls=(), **more) -> Case:
    """A rod, or what is asked for, of 1 kg/m."""
    return Case.from_dict(
        {
            "mesh": mesh or {"generator": "rod", "length": 1.0, "elements": 1},
            "material": {"default": {"young_modulus": 1e4, "density": 1.0}},
            "section": {"default": {"area": 1.0, "material": "default"}},
            "wall": [{"type": "plane", "name": f"wall{k}", **wall} for k, wall in enumerate(walls)],
            "contact": {"treatment": treatment},
            "time": {"integrator": integrator, "step": step, "end": step * steps, "mass": mass},
            "output": {"fields_every": 0},
            **more,
        }
    )


def unexplained(history) -> float:
    """Momentum that no impulse explains, relative to the largest impulse."""
    momentum = history["momentum"] - history["momentum"][0]
    names = [name for name in history if name.endswith(("_impulse", "/impulse"))]
    names = [name for name in names if not name.startswith("pair/")]  # they cancel
    left = momentum - sum(history[name] for name in names)
    return np.abs(left).max() / max(np.abs(history[name]).max() for name in names)


def floor(**more):
    """A wall below."""
    return {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], **more}


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


@pytest.mark.parametrize("treatment", ["scheme", "stick", "conserving", "mass_redistribution", "consistent"])
@pytest.mark.parametrize("integrator", SCHEMES)
def test_momentum_is_that_of_impulses_and_jumps(integrator, treatment, shared_tmp_path):
    """Each force's impulse by the scheme's own rule, and what treatments change, make the momentum of the truss."""
    if treatment == "conserving" and integrator not in ("newmark", "houbolt", "energy_momentum"):
        pytest.skip("the scheme does not go with the treatment")
    if treatment == "mass_redistribution" and integrator in ("chung_lee", "hulbert_chung"):
        pytest.skip("the scheme does not go with the treatment")
    mass = "consistent" if treatment == "consistent" else "lumped"
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=60,
            mass=mass,
            treatment="scheme" if treatment == "consistent" else treatment,
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            node_set={"tip": {"nearest": [1.0, 0.0, 0.0]}, "root": {"nearest": [0.0, 0.0, 0.0]}},
            walls=[{"point": [1.007, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "tip"}],
            support=[{"node_set": "root", "fix": "y"}],
            load=[{"node_set": "root", "force": [3.0, 2.0, 0.0], "table": [[0.0, 1.0], [0.03, -1.0], [1.0, 0.0]]}],
            initial={"velocity": [1.0, 0.0, 0.0]},
        ),
        shared_tmp_path,
    )
    assert history["wall/wall0/contacts"].any()
    assert unexplained(history) < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()
    if treatment == "conserving":
        assert np.abs(history["wall/wall0/jump_impulse"]).max() > 0.01
    if treatment in ("conserving", "mass_redistribution"):
        assert not history["impact_dissipation"].any()


def test_impulses_with_damping_and_halved_steps(shared_tmp_path, comm, monkeypatch):
    """Houbolt's method forgets its history when a step is halved; so does the rule of the impulses."""
    from pfem_petsc import Simulation, open_result

    material = {"default": {"young_modulus": 1e4, "density": 1.0, "damping": 20.0}}
    made = case(
        "houbolt",
        step=1e-3,
        steps=20,
        material=material,
        gravity={"acceleration": [1.0, 2.0, 3.0]},
        initial={"velocity": [1.0, 0.0, 0.0]},
    )
    simulation = Simulation(made, comm, shared_tmp_path, quiet=True)
    stepper = simulation.stepper
    step = stepper.step

    def halved():
        if stepper.state.step == 7:
            stepper.level = 2
        step()

    monkeypatch.setattr(stepper, "step", halved)
    simulation.run()
    history = open_result(shared_tmp_path).history
    history = {name: history[name] for name in history}
    assert history["step_size"].min() == pytest.approx(2.5e-4)
    assert np.abs(history["damping_impulse"]).max() > 0.01
    assert unexplained(history) < 1e-12


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("integrator", SCHEMES)
def test_impulses_of_supports_that_move(integrator, mass, shared_tmp_path):
    """Velocities that a motion prescribes are not the scheme's: the difference is an impulse of the support."""
    motion = [[0.0, 0.0, 0.0, 0.0], [0.01, 0.005, 0.001, 0.0], [0.02, 0.006, -0.002, 0.0], [0.03, 0.0, 0.0, 0.0]]
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=40,
            mass=mass,
            mesh={"generator": "rod", "length": 1.0, "elements": 3},
            node_set={"root": {"nearest": [0.0, 0.0, 0.0]}},
            support=[{"node_set": "root", "fix": "xyz", "motion": motion}],
        ),
        shared_tmp_path,
    )
    assert np.abs(history["support_impulse"]).max() > 0.1
    assert unexplained(history) < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


@pytest.mark.parametrize("integrator", SCHEMES)
def test_friction_takes_the_energy_of_sliding(integrator, shared_tmp_path):
    """A rod that slides on a rough floor until it stands: friction has its kinetic energy, and impact nothing."""
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=40,
            walls=[floor(friction=0.5)],
            gravity={"acceleration": [0.0, 0.0, -GRAVITY]},
            initial={"velocity": [0.0, 0.1, 0.0]},
        ),
        shared_tmp_path,
    )
    assert history["friction_dissipation"][-1] == pytest.approx(0.5 * 0.1**2, rel=0.06)  # the drag of whole steps
    assert (np.diff(history["friction_dissipation"]) > -1e-15).all()
    assert history["impact_dissipation"][-1] < 1e-12
    assert unexplained(history) < 1e-9


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


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "houbolt", "generalized_alpha"])
@pytest.mark.parametrize("load", ["gravity", "heat"])
def test_nodes_without_mass_start_in_equilibrium(integrator, load, shared_tmp_path):
    """Loads that massless nodes are not in equilibrium with at the start, and changing temperatures, open nothing."""
    more = {"gravity": {"acceleration": [30.0, 0.0, 0.0]}}
    if load == "heat":
        more = {
            "temperature": [{"table": [[0.0, 20.0], [0.02, 200.0], [1.0, 0.0]]}],
            "initial": {"velocity": [0.5, 0.0, 0.0]},
        }
        more["material"] = {"default": {"young_modulus": 1e4, "density": 1.0, "thermal_expansion": 1e-5}}
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=60,
            treatment="mass_redistribution",
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            node_set={"tip": {"nearest": [1.0, 0.0, 0.0]}},
            walls=[{"point": [1.01, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "tip"}],
            **more,
        ),
        shared_tmp_path,
    )
    assert history["wall/wall0/contacts"].any()
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * scale
    assert unexplained(history) < 1e-11


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


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "generalized_alpha"])
def test_supports_that_move_beside_nodes_without_mass(integrator, shared_tmp_path):
    """The mass of a node on an oblique wall couples the components of its neighbour, whose x a support moves."""
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=40,
            treatment="mass_redistribution",
            mesh={"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 0.5},
            node_set={"right": {"group": "right"}, "left": {"group": "left"}, "middle": {"box": MIDDLE}},
            walls=[{"point": [0.51, 0.5, 0.0], "normal": [-2.0, -1.0, 0.5], "node_set": "right"}],
            support=[
                {"node_set": "middle", "fix": "x", "motion": [[0.0, 0, 0, 0], [0.015, 0.02, 0, 0], [1.0, 0, 0, 0]]}
            ],
            initial={"velocity": [0.2, 0.1, 0.0]},
        ),
        shared_tmp_path,
    )
    assert np.abs(history["external_work"]).max() > 0.0
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * scale
    assert unexplained(history) < 1e-9


def test_a_node_without_mass_turns_round_its_bar(shared_tmp_path):
    """The bar comes square to the way of its node, where its force alone holds it: no move may be far."""
    history = run(
        case(
            "central_differences",
            step=1e-3,
            steps=300,
            treatment="mass_redistribution",
            mesh={"generator": "rod", "length": 1.0, "elements": 2},
            node_set={"tip": {"group": "end"}, "root": {"group": "start"}},
            walls=[{"point": [1.2, 0.1, 0.0], "normal": [-2.0, -1.0, 0.0], "node_set": "tip"}],
            support=[{"node_set": "root", "fix": "xyz", "motion": [[0.0, 0, 0, 0], [0.3, -0.5, 2.0, 0]]}],
            initial={"velocity": [0.0, -3.0, 0.0]},
        ),
        shared_tmp_path,
    )
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * scale


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
    chatters = integrator in ("chung_lee", "houbolt", "generalized_alpha", "energy_momentum")
    assert history["impact_dissipation"][1] == pytest.approx(stopped, rel=1e-9)
    assert chatters or history["impact_dissipation"][-1] == pytest.approx(stopped, rel=1e-9)
    assert (np.diff(history["damping_dissipation"]) >= 0.0).all()
    assert unexplained(history) < 1e-9


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


@pytest.mark.parametrize("integrator", ["central_differences", "hulbert_chung"])
def test_consistent_mass_of_explicit_schemes_leaves_no_impulse(integrator, tmp_path):
    """What the solver leaves of a balance is an impulse that nothing accounts for: 2e-9 of the momentum before."""
    truss = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "bcc", "cells": [1, 3, 2], "pitch": 0.25},
            "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"s": {"area": 1e-3, "material": "m"}},
            "node_set": {"bottom": {"group": "bottom"}},
            "support": [{"node_set": "bottom", "fix": "xy", "velocity": [0.2, -0.1, 0.0]}],
            "gravity": {"acceleration": [100.0, -20.0, -180.0]},
            "initial": {"velocity": [-1.0, 1.0, 1.0], "angular_velocity": [0.0, 0.6, -1.0]},
            "time": {"integrator": integrator, "mass": "consistent", "step": 4e-4, "end": 0.04},
            "output": {"fields_every": 0},
            "solver": {"linear": "cg", "rtol": 1e-9},
        }
    )
    simulation = Simulation(truss, MPI.COMM_SELF, output=tmp_path, quiet=True)
    rows = [step.row for step in simulation]
    change = rows[-1]["momentum"] - rows[0]["momentum"]
    impulses = sum(rows[-1][name] - rows[0][name] for name in ("external_impulse", "support_impulse"))
    assert np.abs(change - impulses).max() < 2e-11 * np.abs(rows[-1]["momentum"]).max()
    energy = rows[-1]["kinetic_energy"] + rows[-1]["elastic_energy"]
    assert abs(rows[-1]["energy_imbalance"]) < 2e-11 * energy
