"""Equilibria at increasing load factors against closed forms; automatic increments, contact, restarts, refusals."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from helpers.small_models import case_of
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError, SimulationFailure

HALF, HEIGHT, YOUNG, AREA = 1.0, 0.2, 1e9, 1e-4
RESULTANT = {  # axial force times dl/dz over E A: (strain, derivative of the strain by the length) of l over l0
    "engineering": lambda s: s - 1.0,
    "green": lambda s: 0.5 * (s * s - 1.0) * s,
    "logarithmic": lambda s: np.log(s) / s,
}


def truss(folder, comm, push=(0.0, 0.0, -100.0), strain="engineering", **tables):
    """Two bars that meet in a crown, which moves up and down."""
    points = [[0.0, 0.0, 0.0], [HALF, 0.0, HEIGHT], [2.0 * HALF, 0.0, 0.0]]
    material = {"steel": {"young_modulus": YOUNG, "density": 1000.0, "strain": strain}}
    given = {
        "node_set": {"feet": {"indices": [0, 2]}, "crown": {"indices": [1]}},
        "material": material,
        "section": {"all": {"area": AREA, "material": "steel"}},
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "crown", "fix": "y"}],
        "load": [{"node_set": "crown", "force": list(push)}],
        "static": {"step": 0.1},
        "output": {"fields_every": 1, "probe": [{"name": "crown", "node_set": "crown"}]},
    } | tables
    return case_of(folder, comm, points, [[0, 1], [1, 2]], **given)


def history_of(case, comm, folder, **options):
    with Simulation(case, comm, output=folder / "out", quiet=True, **options) as simulation:
        simulation.run()
    return open_result(folder / "out" / "result.vtkhdf").history


@pytest.mark.parallel
@pytest.mark.parametrize("strain", RESULTANT)
def test_every_point_is_on_the_closed_form(shared_tmp_path, comm, strain):
    history = history_of(truss(shared_tmp_path, comm, strain=strain), comm, shared_tmp_path)
    z, factor = history["probe/crown/position"][:, 0, 2], history["load_factor"]
    rest, length = np.hypot(HALF, HEIGHT), np.hypot(HALF, z)
    force = -2.0 * YOUNG * AREA * RESULTANT[strain](length / rest) * z / length
    np.testing.assert_allclose(factor, np.linspace(0.0, 1.0, 11), rtol=1e-12)
    np.testing.assert_array_equal(history["time"], factor)
    np.testing.assert_allclose(force, 100.0 * factor, rtol=1e-9, atol=1e-9)
    assert abs(history["energy_imbalance"]).max() < 1e-10 * history["elastic_energy"].max()


def test_a_limit_point_ends_the_run_with_the_load_factor_that_was_reached(shared_tmp_path, comm):
    case = truss(shared_tmp_path, comm, push=(0.0, 0.0, -600.0))
    with pytest.raises(SimulationFailure, match=r"no equilibrium found beyond load factor 0\.49.*arc_length") as error:
        history_of(case, comm, shared_tmp_path)
    assert "static.stabilise and dynamic stages" in str(error.value)
    assert "static.end" in str(error.value)  # without it a path goes on for as many points as it may have
    assert "educe static.step" not in str(error.value)  # increments down to a thousandth of it have failed
    assert "solver.linear" not in str(error.value)  # the linear solver is direct already
    history = open_result(shared_tmp_path / "out" / "result.vtkhdf").history
    z = np.linspace(0.0, HEIGHT, 200001)
    length, rest = np.hypot(HALF, z), np.hypot(HALF, HEIGHT)
    limit = (2.0 * YOUNG * AREA * (1.0 - length / rest) * z / length).max() / 600.0
    assert limit - 2e-4 < history["load_factor"][-1] <= limit


@pytest.mark.parallel
@pytest.mark.parametrize("stabilise", [1e-3, 1e-4])
def test_stabilised_increments_snap_through(shared_tmp_path, comm, stabilise):
    """Beyond the limit point the crown goes on to the inverted state, whose equilibrium has no viscosity left in it."""
    static = {"step": 0.05, "min_step": 1e-6, "stabilise": stabilise}
    history = history_of(truss(shared_tmp_path, comm, push=(0.0, 0.0, -600.0), static=static), comm, shared_tmp_path)
    z = history["probe/crown/position"][-1, 0, 2]
    length, rest = np.hypot(HALF, z), np.hypot(HALF, HEIGHT)
    assert z < -HEIGHT
    assert 2.0 * YOUNG * AREA * (1.0 - length / rest) * z / length == pytest.approx(600.0, rel=1e-8)
    assert history["load_factor"][-1] == 1.0
    assert (np.diff(history["damping_dissipation"]) >= 0.0).all()
    assert history["damping_dissipation"][-1] > history["elastic_energy"][-1]
    assert abs(history["energy_imbalance"]).max() < 1e-8 * history["external_work"][-1]


def test_loads_and_gravity_grow_with_the_load_factor_and_tables_are_over_it(shared_tmp_path, comm):
    tables = {
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "load": [
            {"node_set": "crown", "force": [0.0, 0.0, -100.0]},
            {"node_set": "crown", "force": [0.0, 0.0, -50.0], "table": [[0.0, 0.0], [0.5, 1.0], [1.0, 0.0]]},
        ],
    }
    case = truss(shared_tmp_path, comm, **tables)
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        simulation.run()
        mass = simulation.model.total_mass
    history = open_result(shared_tmp_path / "out" / "result.vtkhdf").history
    factor = history["load_factor"]
    expected = 100.0 * factor + 50.0 * (1.0 - abs(2.0 * factor - 1.0)) + mass * 9.81 * factor
    np.testing.assert_allclose(history["support_force"][1:, 2], expected[1:], rtol=1e-9)


def test_a_wall_presses_a_truss(shared_tmp_path, comm):
    """A plate moves onto the crown by a table over the load factor: force and positions of the closed form."""
    down = 0.15 * HEIGHT
    plate = {
        "name": "plate",
        "type": "plane",
        "point": [0.0, 0.0, HEIGHT],
        "normal": [0.0, 0.0, -1.0],
        "node_set": "crown",
        "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -down]],
        "interpolation": "linear",
    }
    case = truss(shared_tmp_path, comm, push=(0.0, 0.0, 0.0), wall=[plate])
    history = history_of(case, comm, shared_tmp_path)
    z = HEIGHT - down * history["load_factor"]
    rest, length = np.hypot(HALF, HEIGHT), np.hypot(HALF, z)
    np.testing.assert_allclose(history["probe/crown/position"][:, 0, 2], z, rtol=1e-10)
    expected = 2.0 * YOUNG * AREA * (length / rest - 1.0) * z / length
    np.testing.assert_allclose(history["wall/plate/force"][1:, 2], expected[1:], rtol=1e-7)
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["elastic_energy"].max()


BOUNCY = {"name": "floor", "type": "plane", "point": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0], "restitution": 0.5}
PAIRED = {"feet": {"indices": [0, 2]}, "crown": {"indices": [1]}, "left": {"indices": [0]}, "right": {"indices": [2]}}
PAIR = {"name": "feet", "first": "left", "second": "right", "direction": [1.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"initial": {"velocity": [1.0, 0.0, 0.0]}}, ["initial", "no velocities"]),
        ({"contact": {"treatment": "stick"}}, ["contact.treatment", "impacts"]),
        ({"wall": [BOUNCY]}, ["wall 'floor': restitution = 0.5", "a static analysis", "remove the key, or use [time]"]),
        (
            {"contact_pair": [{**PAIR, "restitution": 0.25}], "node_set": PAIRED},
            ["contact_pair 'feet': restitution = 0.25", "remove the key"],
        ),
        ({"self_contact": {"restitution": 0.9}}, ["self_contact: restitution = 0.9", "remove the key"]),
        ({"support": []}, ["rigid-body motions", "[[support]]"]),
        ({"static": {"step": 0.1, "max_step": 0.01}}, ["max_step", "smaller than step"]),
        ({"static": {"method": "newtons"}}, ["static.method", "did you mean 'newton'"]),
        (
            {"static": {}, "time": {"integrator": "newmark", "step": 1.0, "end": 1.0}},
            ["[time] and [static]", "exclude each other"],
        ),
    ],
)
def test_what_a_static_analysis_does_not_have_is_refused(shared_tmp_path, comm, tables, words):
    with pytest.raises(InputError) as refused:
        Simulation(truss(shared_tmp_path, comm, **tables), comm, output=shared_tmp_path / "out", quiet=True)
    for word in words:
        assert word in str(refused.value)


@pytest.mark.parametrize("kinds", [("static", "time"), ("time", "static"), ("static", "static")])
def test_static_stages_have_restitution_only_beside_one_with_time(shared_tmp_path, comm, kinds):
    analyses = {"static": {}, "time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4}}
    data = truss(shared_tmp_path, comm).to_dict()
    del data["static"]
    data |= {"wall": [BOUNCY], "self_contact": {"restitution": 0.9}}
    data["stage"] = [{"name": f"stage{k}", kind: analyses[kind]} for k, kind in enumerate(kinds)]
    case, expected = Case.from_dict(data, folder=shared_tmp_path), nullcontext()
    if "time" not in kinds:
        expected = pytest.raises(InputError, match=r"wall 'floor': restitution = 0.5 .* a static analysis has none")
    with expected:
        Simulation(case, comm, output=shared_tmp_path / "out", quiet=True, check_only=True)


def test_a_case_needs_an_analysis(shared_tmp_path, comm):
    data = truss(shared_tmp_path, comm).to_dict()
    del data["static"]
    with pytest.raises(InputError, match=r"\[time\] is missing, or one of \[static\]"):
        Case.from_dict(data, folder=shared_tmp_path)


@pytest.mark.parallel
def test_energy_is_balanced_from_a_start_that_is_not_in_equilibrium(shared_tmp_path, comm):
    """Hot from the start between fixed feet, with a load that does not begin at zero."""
    material = {"steel": {"young_modulus": YOUNG, "density": 1000.0, "thermal_expansion": 1e-5}}
    load = [{"node_set": "crown", "force": [0.0, 0.0, -50.0], "table": [[0.0, 1.0], [1.0, 2.0]]}]
    case = truss(shared_tmp_path, comm, material=material, temperature=[{"value": 50.0}], load=load)
    history = history_of(case, comm, shared_tmp_path)
    assert abs(history["energy_imbalance"]).max() < 1e-10 * history["elastic_energy"].max()
    assert not history["probe/crown/acceleration"].any()


def test_a_viscous_bar_that_yields_under_its_load_does_not_lack_supports(shared_tmp_path, comm):
    """Of a motion that leaves it above the yield stress, a static stage says that nothing resists more load."""
    sets = {"every": {"all": True}, "base": {"indices": [0]}, "tip": {"indices": [1]}}
    tables = {
        "node_set": sets,
        "material": {
            "steel": {
                "law": "perzyna",
                "young_modulus": 1e7,
                "density": 1000.0,
                "yield_stress": 1e4,
                "fluidity": 100.0,
            }
        },
        "support": [{"node_set": "every", "fix": "yz"}, {"node_set": "base", "fix": "x"}],
        "load": [{"node_set": "tip", "force": [1.5, 0.0, 0.0]}],
        "stage": [
            {"name": "pull", "time": {"integrator": "newmark", "step": 1e-4, "end": 0.02}},
            {"name": "rest", "static": {"step": 0.25}},
        ],
    }
    case = case_of(shared_tmp_path, comm, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0, 1]], **tables)
    with pytest.raises(SimulationFailure, match="Bars yield there, and without hardening nothing resists") as error:
        history_of(case, comm, shared_tmp_path)
    assert "upports" not in str(error.value)


def test_the_cause_of_a_failure_is_told_where_nothing_changes_with_the_load_factor(tmp_path):
    """Bars that yield, in a stage that only lets what moved come to rest: there is no response to look along."""
    yields = {"m": {"young_modulus": 1e6, "density": 1e3, "yield_stress": 1e3, "isotropic_hardening": 1e4}}
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": {"start": {"group": "start"}, "all": {"all": True}},
        "material": yields,
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "start", "fix": "x"}, {"node_set": "all", "fix": "yz"}],
        "static": {"step": 0.5},
    }
    with Simulation(Case.from_dict(data), MPI.COMM_SELF, tmp_path, quiet=True) as simulation:
        simulation.run()
        assert "no limit point" in simulation.stepper._limit_point(0.5)
