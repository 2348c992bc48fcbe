"""Treatments of impact: what each conserves, for the rod whose exact force is constant and which loses no energy."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError

TRAPEZOID = {"beta": 0.25, "gamma": 0.5}
FORCE, ENERGY = 0.1, 0.005  # rho c A v and m v^2/2 of the rod at v = 0.1


def rod(treatment, integrator, comm, folder, step=0.01, **parameters):
    """Largest force over the exact one, energies over that of the start, and the rows."""
    overrides = [
        f"time.integrator={integrator}",
        f"time.step={step}",
        "output.fields_every=0",
        f'contact.treatment="{treatment}"',
        "initial.velocity=[0.1, 0, 0]",
        "time.end=4.0",
    ]
    overrides += [f"time.{name}={value}" for name, value in parameters.items()]
    run = Simulation(Case.load("rod_impact", overrides), comm, output=folder / "rod", quiet=True)
    rows = [s.row for s in run]
    force = max(abs(row["wall/wall/force"][0]) for row in rows) / FORCE
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows]) / ENERGY
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10 * ENERGY
    return force, energy, rows


@pytest.mark.parametrize("step", [0.005, 0.01, 0.02])
def test_no_mass_no_spike_explicit(step, comm, shared_tmp_path):
    """The force spike no longer grows as 1/h, and impact takes no energy."""
    force, energy, rows = rod("mass_redistribution", "central_differences", comm, shared_tmp_path, step)
    assert force < 1.35 and energy[-1] == pytest.approx(1.0, abs=3e-3)
    assert rows[-1]["wall/wall/releases"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
@pytest.mark.parametrize("fix, normal", [("z", [-1.0, 0.0, 0.0]), ("yz", [-1.0, 0.0, 0.0]), ("z", [-0.8, 0.0, 0.6])])
def test_no_mass_where_supports_hold_other_directions(integrator, fix, normal, comm, shared_tmp_path):
    """A node that cannot move in some directions is stopped along the free part of the wall's normal."""
    keys = [
        f"time.integrator={integrator}",
        'contact.treatment="mass_redistribution"',
        "output.fields_every=0",
        "initial.velocity=[0.1, 0, 0]",
        "time.end=2.6",
    ]
    held = ["node_set.all.all=true", f'support=[{{node_set="all", fix="{fix}"}}]', f"wall.0.normal={normal}"]
    runs = []
    for more in ([], held):
        run = Simulation(Case.load("rod_impact", keys + more), comm, output=shared_tmp_path / "rod", quiet=True)
        runs.append([step.row for step in run])
    for free, fixed in zip(*runs, strict=True):
        assert fixed["probe/tip/position"][0, 0] == pytest.approx(free["probe/tip/position"][0, 0], abs=1e-11)
        assert fixed["wall/wall/force"][0] == pytest.approx(free["wall/wall/force"][0], abs=1e-9)
        across = normal[2] / normal[0] * fixed["wall/wall/force"][0]
        assert fixed["wall/wall/force"][2] == pytest.approx(across, abs=1e-12)
    assert max(row["probe/tip/position"][0, 0] for row in runs[1]) < 1.05 + 1e-12
    assert min(row["wall/wall/force"][0] for row in runs[1]) < -FORCE


def test_no_mass_where_supports_hold_the_normal(comm, shared_tmp_path):
    """A wall is no concern of a node that supports hold along its normal; the node keeps its mass."""
    keys = ['contact.treatment="mass_redistribution"', 'support=[{node_set="tip", fix="xyz"}]', "time.end=0.05"]
    run = Simulation(Case.load("rod_impact", keys), comm, output=shared_tmp_path / "rod", quiet=True)
    run.run()
    assert comm.allreduce(len(run.model.inertia.redistribution.nodes)) == 0


@pytest.mark.parallel
def test_no_mass_beside_ghosts(comm, shared_tmp_path):
    """Bars of massless nodes that end at nodes of another rank have the lengths of the new positions."""
    case = {
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [1, 2, 2], "pitch": 0.4},
        "node_set": {"front": {"group": "front"}},
        "material": {"it": {"young_modulus": 2e5, "density": 6500.0}},
        "section": {"it": {"area": 9e-4, "material": "it"}},
        "wall": [{"name": "wall", "type": "plane", "point": [0, -0.02, 0], "normal": [0, 1, 0], "node_set": "front"}],
        "contact": {"treatment": "mass_redistribution"},
        "time": {"integrator": "central_differences", "step": 0.05, "end": 0.25},
        "output": {"fields_every": 0},
    }
    run = Simulation(Case.from_dict(case), comm, output=shared_tmp_path / "lattice", quiet=True)
    assert len(list(run)) == 5 and np.abs(run.state.v).max(initial=0.0) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.01, 0.05])
@pytest.mark.parametrize("integrator, parameters", [("newmark", TRAPEZOID), ("energy_momentum", {})])
def test_no_mass_no_spike_implicit(integrator, parameters, step, comm, shared_tmp_path):
    force, energy, _ = rod("mass_redistribution", integrator, comm, shared_tmp_path, step, **parameters)
    assert force < 1.35 and energy[-1] == pytest.approx(1.0, abs=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", [("newmark", TRAPEZOID), ("energy_momentum", {})])
def test_conserving_keeps_energy(integrator, parameters, comm, shared_tmp_path):
    _, energy, rows = rod("conserving", integrator, comm, shared_tmp_path, **parameters)
    np.testing.assert_allclose(energy, 1.0, atol=1e-6)
    assert abs(rows[-1]["contact_work"]) < 1e-9 * ENERGY


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, parameters",
    [
        ("newmark", TRAPEZOID),
        ("newmark", {}),
        ("houbolt", {}),
        ("wilson", {"theta": 1.4}),
        ("chung_lee", {}),
        ("central_differences", {}),
        ("generalized_alpha", {}),
        ("energy_momentum", {}),
    ],
)
def test_stick_never_gains_energy(integrator, parameters, comm, shared_tmp_path):
    """Also where the scheme's own formulas blow up (trapezoid, wilson 1.4); contact takes the tip's energy, 2.5 %."""
    _, energy, rows = rod("stick", integrator, comm, shared_tmp_path, **parameters)
    assert energy.max() <= 1.0 + 1e-6
    assert rows[-1]["impact_dissipation"] > 0.0 and rows[-1]["contact_work"] == 0.0
    if parameters == TRAPEZOID:
        assert energy[-1] == pytest.approx(0.975, abs=1e-3)
        assert rows[-1]["impact_dissipation"] == pytest.approx(0.025 * ENERGY, rel=0.02)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_mass_redistribution_of_a_lattice(integrator, comm, shared_tmp_path):
    """Flat impact on an oblique wall: momentum of the truss changes by the walls' impulse, energy comes back."""
    walls = planes([[0.0, 0.2, 1.0]], [-0.01], node_set="foot")
    case = lattice_case(
        walls,
        velocity=[0.2, 0.1, -1.0],
        integrator=integrator,
        step=2e-4,
        end=0.03,
        cells=[2, 2, 1],
        node_set={"foot": {"box": [[-1, -1, -1e-6], [1, 1, 1e-6]]}},
        solver={"rtol": 1e-12},
        contact={"treatment": "mass_redistribution"},
    )
    if integrator == "newmark":
        case["time"] |= TRAPEZOID
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    change = rows[-1]["momentum"] - run.model.total_mass * np.array([0.2, 0.1, -1.0])
    np.testing.assert_allclose(rows[-1]["wall/wall1/impulse"], change, atol=0.02 * abs(change[2]))
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    assert np.abs(energy / energy[0] - 1.0).max() < 0.02
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10 * energy[0]
    assert max(row["active_contacts"] for row in rows) >= 3


@pytest.mark.slow
@pytest.mark.parallel
def test_mass_redistribution_without_a_matrix(comm, shared_tmp_path):
    """What is chosen beyond 500 unknowns gives what a direct solution does."""
    found = []
    for solver in ({}, {"linear": "mumps"}):
        case = lattice_case(
            planes([[0.0, 0.2, 1.0]], [-0.001], node_set="foot"),
            velocity=[0.2, 0.1, -1.0],
            integrator="newmark",
            step=4e-4,
            end=0.008,
            cells=[4, 3, 3],
            node_set={"foot": {"box": [[-1, -1, -1e-6], [1, 1, 1e-6]]}},
            solver={"rtol": 1e-12, **solver},
            contact={"treatment": "mass_redistribution"},
        )
        case["time"] |= TRAPEZOID
        run = simulation(case, comm, shared_tmp_path, "it")
        assert run.plan.linear.matrix_free == (solver == {})
        rows = [step.row for step in run]
        assert max(row["active_contacts"] for row in rows) >= 5
        found.append((np.array([row["wall/wall1/force"] for row in rows]), run.gather(run.state.position)))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-8 * np.abs(found[0][0]).max())
    if comm.rank == 0:
        np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-10)


CONSERVING = (
    'contact.treatment = "conserving" with time.integrator = "central_differences": it is compatible with the '
    "integrators energy_momentum, houbolt, newmark only"
)


@pytest.mark.parametrize(
    "tables, message",
    [
        ({"contact": {"treatment": "conserving"}}, CONSERVING),
        (
            {"contact": {"treatment": "mass_redistribution"}},
            "must be a plane, not curved nor a rectangle, must not turn, and name a node_set",
        ),
        ({"contact": {"treatment": "sticky"}}, "contact.treatment"),
    ],
)
def test_refusals(tables, message, comm, shared_tmp_path):
    case = lattice_case(planes([[0.0, 0.0, 1.0]], [-0.01]), **tables)
    with pytest.raises(InputError, match=message):
        simulation(case, comm, shared_tmp_path)


def test_stick_with_friction_far_from_the_origin(tmp_path):
    """Slips of rounding errors have no direction: a rod that arrives on a rough plane moves alike a kilometre away."""

    def velocity(away):
        points = np.column_stack([np.linspace(0.0, 0.7, 13), np.zeros((13, 2))]) + away
        table = {
            "material": {"m": {"young_modulus": 2.25e7, "density": 2100.0}},
            "section": {"s": {"area": 9e-3, "material": "m"}},
            "node_set": {"start": {"indices": [0]}, "every": {"all": True}},
            "initial": {"velocity": [-0.077, 0.017, 0.31]},
            "wall": [
                {"name": "w", "node_set": "start", "type": "plane", "point": [away] * 3, "normal": [0.54, 0.14, -2.95]}
                | {"friction": 0.11, "static_friction": 0.16}
            ],
            "contact": {"treatment": "stick"},
            "time": {"integrator": "wilson", "step": 2.2e-4, "end": 2.2e-3},
            "output": {"fields_every": 0, "probe": [{"name": "p", "node_set": "every"}]},
        }
        bars = np.column_stack([np.arange(12), np.arange(1, 13)])
        folder = tmp_path / str(away)
        Simulation(Case.from_dict(table, mesh=Truss(points, bars)), output=folder, quiet=True).run()
        return open_result(folder).history["probe/p/velocity"]

    near = velocity(0.0)
    assert np.abs(near).max() > 0.05
    np.testing.assert_allclose(velocity(1000.0), near, rtol=0.0, atol=1e-6)
