"""Stages of one bar against closed forms: loads, supports and walls that stay, go or are replaced."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import inspected
from helpers.small_models import check_balances

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import SimulationFailure

YOUNG, AREA, DENSITY = 1e4, 1.0, 1.0
LEFT = {"name": "left", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]}
RIGHT = {"name": "right", "type": "plane", "point": [1.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
LINE = {"node_set": "all", "fix": "yz"}
HELD = {"node_set": "base", "fix": "x"}
FLY = {"integrator": "central_differences", "step": 1e-4, "end": 0.02}


def bar(stages, material=(), **tables):
    """A bar of one element along x, which stays on its line; two masses of 0.5 kg and a stiffness of 10 kN/m."""
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": {"all": {"all": True}, "base": {"indices": [0]}, "tip": {"indices": [1]}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY, **dict(material)}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "support": [LINE, HELD],
        "output": {
            "fields_every": 0,
            "probe": [{"name": "tip", "node_set": "tip"}, {"name": "all", "node_set": "all"}],
        },
        "stage": stages,
    }
    return Case.from_dict(data | tables, name="bar")


@pytest.fixture
def run(comm, shared_tmp_path):
    def run(case, **options):
        folder = shared_tmp_path / f"{len(list(shared_tmp_path.iterdir()))}"
        comm.Barrier()
        with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
            simulation.run()
        history = open_result(folder).history
        found = {name: history[name] for name in history}
        comm.Barrier()
        check_balances(found)
        return found

    return run


def pull(force, **more):
    return {"node_set": "tip", "force": [force, 0.0, 0.0], **more}


@pytest.mark.slow
@pytest.mark.parallel
def test_press_and_release_beyond_yield(run):
    """Pulled beyond yield, let go in equilibrium, and free to move: the plastic strain stays."""
    limit, hardening, force = 50.0, 1000.0, 60.0
    stages = [
        {"name": "pull", "static": {"step": 0.25}, "load": [pull(force)]},
        {"name": "release", "static": {"step": 0.25}, "load": []},
        {"name": "watch", "time": {"integrator": "newmark", "step": 1e-3, "end": 0.02}},
    ]
    history = run(bar(stages, {"yield_stress": limit, "kinematic_hardening": hardening}))
    x = history["probe/tip/position"][:, 0, 0]
    plastic = (force - limit) / hardening
    assert x[4] == pytest.approx(1.0 + plastic + force / YOUNG, rel=1e-9)
    # what a static stage takes away fades with its load factor
    np.testing.assert_allclose(history["support_force"][4:9, 0], -force * np.linspace(1.0, 0.0, 5), atol=1e-7)
    np.testing.assert_allclose(x[8:], 1.0 + plastic, rtol=1e-12)
    np.testing.assert_allclose(history["plastic_dissipation"][4:], plastic * (limit + force) / 2.0, rtol=1e-9)


@pytest.mark.slow
def test_loads_stay_or_are_replaced(run):
    stages = [
        {"name": "first", "static": {"step": 0.5, "end": 0.5}, "load": [pull(2.0)]},
        {"name": "stays", "static": {"step": 0.5}},
        {"name": "replaced", "static": {"step": 0.25}, "load": [pull(5.0)]},
        {"name": "by a table", "static": {"step": 0.5}, "load": [pull(1.0, table=[[0.0, 3.0], [1.0, 2.0]])]},
        {"name": "at once", "time": {**FLY, "end": 1e-3}, "load": [pull(-1.0)]},
        {"name": "goes on", "time": {**FLY, "end": 1e-3}},
    ]
    history = run(bar(stages))
    force = -history["support_force"][:, 0]
    np.testing.assert_allclose(force[:10], [0.0, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 2.0], atol=1e-9)
    x = history["probe/tip/position"][9:, 0, 0]
    # from 2 N to -1 N at once: a mass of 0.5 kg about its new place
    t = history["time"][9:] - history["time"][9]
    swing = 1.0 - 1.0 / YOUNG + 3.0 / YOUNG * np.cos(np.sqrt(2.0 * YOUNG) * t)
    np.testing.assert_allclose(x, swing, atol=2e-3 * 3.0 / YOUNG)
    assert list(np.unique(history["stage"])) == list(range(6))
    np.testing.assert_array_equal(history["load_factor"][[9, 12, -1]], [1.0, 1.0, 1.0])


@pytest.mark.slow
def test_gravity_stays_and_a_bar_that_is_let_go_falls(run):
    weight, h = DENSITY * AREA * 10.0, 1e-4
    stages = [
        {"name": "hangs", "static": {"step": 0.5}, "gravity": {"acceleration": [-10.0, 0.0, 0.0]}},
        {"name": "falls", "time": FLY, "support": [LINE]},
        {"name": "floats", "time": FLY, "gravity": {"acceleration": [0.0, 0.0, 0.0]}},
    ]
    history = run(bar(stages))
    assert history["support_force"][2, 0] == pytest.approx(weight, rel=1e-9)
    t = history["time"][2:203] - history["time"][2]
    np.testing.assert_allclose(history["momentum"][2:203, 0], -weight * t, atol=1e-12)
    fall = history["centre_of_mass"][2:203, 0] - history["centre_of_mass"][2, 0]
    np.testing.assert_allclose(fall, -5.0 * t**2, atol=1e-12)
    assert abs(history["support_force"][3:, 0]).max() == 0.0
    np.testing.assert_allclose(history["momentum"][203:, 0], -weight * 200 * h, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parallel
def test_supports_hold_where_they_are_and_move_from_there(run):
    moved = {"node_set": "base", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.1, 0.0, 0.0]]}
    shaken = {"node_set": "base", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [0.01, 0.2, 0.0, 0.0]]}
    stages = [
        {"name": "moves", "static": {"step": 0.5}, "support": [LINE, moved]},
        {"name": "stays", "time": {"integrator": "newmark", "step": 1e-3, "end": 0.01}},
        {"name": "moves on", "time": {"integrator": "newmark", "step": 1e-3, "end": 0.02}, "support": [LINE, shaken]},
        {"name": "again", "static": {"step": 0.5}, "support": [LINE, moved]},
    ]
    history = run(bar(stages))
    x = history["probe/all/position"][:, 0, 0]
    np.testing.assert_allclose(x[2:13], 0.1, rtol=1e-12)
    np.testing.assert_allclose(x[[22, 32]], 0.3, rtol=1e-12)
    assert x[-1] == pytest.approx(0.4, rel=1e-12)
    assert history["probe/tip/position"][-1, 0, 0] == pytest.approx(1.4, rel=1e-12)


@pytest.mark.slow
def test_preload_flight_and_rest_on_a_floor(run):
    """Pressed between two walls, let go by one of them, and fallen back onto the other."""
    press, mass, stiffness = 0.01, 0.5, YOUNG * AREA
    plate = {**RIGHT, "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, -press, 0.0, 0.0]], "interpolation": "linear"}
    falls = {
        "name": "falls",
        "gravity": {"acceleration": [-10.0, 0.0, 0.0]},
        "contact": {"treatment": "stick"},
        "time": {"integrator": "newmark", "step": 2e-3, "end": 1.6},
    }
    stages = [
        {"name": "press", "static": {"step": 0.25}, "wall": [LEFT, plate]},
        {"name": "held", "time": FLY},
        {"name": "flies", "time": FLY, "wall": [LEFT]},
        falls,
    ]
    history = run(bar(stages, support=[LINE]))
    np.testing.assert_allclose(history["wall/left/force"][4:205, 0], stiffness * press, rtol=1e-12)
    np.testing.assert_allclose(history["wall/right/force"][4:205, 0], -stiffness * press, rtol=1e-9)
    assert not history["wall/right/force"][205:].any()
    np.testing.assert_array_equal(history["wall/right/impulse"][205:, 0], history["wall/right/impulse"][204, 0])
    made = mass * press * np.sqrt(stiffness / mass)  # of the moving end, when the bar has its length again
    assert history["momentum"][404, 0] == pytest.approx(made, rel=1e-3)
    assert history["wall/left/contacts"][404] == 0
    assert history["wall/left/force"][-1, 0] == pytest.approx(10.0, rel=1e-6)
    assert history["kinetic_energy"][-1] < 1e-9


@pytest.mark.slow
def test_velocities_are_added_at_the_start_of_their_stage(run):
    kick = {"name": "kick", "time": FLY, "initial": {"velocity": [0.3, 0.0, 0.0]}}
    stages = [{"name": "flies", "time": FLY, "support": [LINE], "initial": {"velocity": [0.2, 0.0, 0.0]}}, kick]
    stages += [{"name": "goes on", "time": {**FLY, "integrator": "houbolt"}}, {**kick, "name": "again"}]
    history = run(bar(stages))
    np.testing.assert_allclose(
        history["momentum"][[0, 200, 201, 400, 401, 600, 601, -1], 0], [0.2, 0.2] + 4 * [0.5] + 2 * [0.8]
    )
    np.testing.assert_allclose(history["external_work"][[200, 201, 601]], [0.0, 0.105, 0.3], atol=1e-12)


def test_a_wall_that_nodes_are_beyond_when_its_stage_begins_is_refused(run):
    stages = [
        {"name": "pull", "static": {"step": 0.5}, "load": [pull(100.0)]},
        {"name": "fly", "time": FLY, "wall": [RIGHT]},
    ]
    told = r"stage 'fly', begun after step 2.*wall 'right': node 1 starts 0\.01 m.*let an earlier stage move the nodes$"
    with pytest.raises(SimulationFailure, match=told):
        run(bar(stages))


@pytest.mark.parallel
def test_walls_and_steps_of_later_stages_are_told_before_the_run(comm):
    """Walls where the mesh is, 0.2 m in it, and 0.3 m away from it; the steps of a static stage are not known."""
    fast, near = FLY | {"step": 5e-5}, RIGHT | {"point": [0.8, 0.0, 0.0]}
    stages = [
        {"name": "push", "static": {"step": 0.5}, "load": [pull(-100.0)]},
        {"name": "fly", "time": FLY, "wall": [RIGHT, near | {"name": "near"}], "output": {"fields_every": 20}},
        {"name": "stays", "time": fast},
        {"name": "caught", "time": FLY, "wall": [LEFT | {"point": [-0.3, 0.0, 0.0]}]},
    ]
    entries, _ = inspected(bar(stages), comm)
    walls = {label: text for label, text in entries.items() if label.startswith("wall ")}
    assert walls == {
        "wall right, stage fly": "gap 0 m at node 1 in the mesh, before earlier stages move it",
        "wall near, stage fly": "node 1 is 200.0 mm beyond it in the mesh: the stage cannot begin unless earlier "
        "stages move such nodes to the allowed side",
        "wall left, stage caught": "gap 300.0 mm at node 0 in the mesh, before earlier stages move it",
    }
    assert "'push'" in entries["not included"] and "'fly'" not in entries["not included"]
    alone, _ = inspected(bar(stages[2:3]), comm)
    assert float(entries["run time"].split()[1]) == pytest.approx(2.0 * float(alone["run time"].split()[1]), rel=0.02)


@pytest.mark.slow
def test_temperatures_stay_and_change(run):
    stages = [
        {"name": "heat", "static": {"step": 0.5}, "temperature": [{"table": [[0.0, 0.0], [1.0, 100.0]]}]},
        {"name": "stays", "static": {"step": 0.5}, "load": [pull(10.0)]},
        {"name": "cold", "static": {"step": 0.5}, "temperature": [{"value": 0.0}], "load": []},
    ]
    history = run(bar(stages, {"thermal_expansion": 1e-5}))
    x = history["probe/tip/position"][:, 0, 0]
    np.testing.assert_allclose(x[[2, 4, 6]], [1.001, 1.001 + 1e-3, 1.0], rtol=1e-12)


@pytest.mark.slow
def test_a_wall_with_mass_moves_on(run):
    """A bar and a wall that it pushes have one momentum, over a change of the integrator too."""
    heavy = {**RIGHT, "point": [1.001, 0.0, 0.0], "mass": 2.0}
    stages = [
        {"name": "meets", "time": FLY, "initial": {"velocity": [1.0, 0.0, 0.0]}, "wall": [heavy]},
        {"name": "pushes", "time": {**FLY, "integrator": "generalized_alpha"}},
    ]
    history = run(bar(stages, support=[LINE]))
    total = history["momentum"][:, 0] + 2.0 * history["wall/right/velocity"][:, 0]
    np.testing.assert_allclose(total, 1.0, rtol=1e-9)
    assert history["wall/right/velocity"][200, 0] > 0.1
    place = history["wall/right/position"][:, 0]
    assert np.diff(place)[200] == pytest.approx(1e-4 * history["wall/right/velocity"][200, 0], rel=0.05)


@pytest.mark.slow
def test_ties_stay(run):
    sticky = {**RIGHT, "point": [1.001, 0.0, 0.0], "tied": True}
    stages = [
        {"name": "meets", "time": FLY, "initial": {"velocity": [1.0, 0.0, 0.0]}, "wall": [sticky]},
        {"name": "hangs", "static": {"step": 0.5}, "load": [{"node_set": "base", "force": [-10.0, 0.0, 0.0]}]},
        {"name": "swings", "time": {**FLY, "integrator": "newmark"}, "load": []},
    ]
    history = run(bar(stages, support=[LINE]))
    x = history["probe/all/position"][:, :, 0]
    np.testing.assert_allclose(x[200:, 1], 1.001, rtol=1e-9)
    assert x[202, 0] == pytest.approx(0.001 - 10.0 / YOUNG, rel=1e-6)
    assert np.ptp(x[203:, 0]) > 1e-4


@pytest.mark.slow
@pytest.mark.parallel
def test_pairs_go_on(run):
    """Two bars one after the other, pressed together by a support, held so, and let go."""
    gap, delta = 1e-4, 2e-3
    way = {"node_set": "last", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, -gap - delta, 0.0, 0.0]]}
    tables = {
        "mesh": {"generator": "two_rods", "length": 1.0, "elements": 1, "gap": gap},
        "node_set": {"all": {"all": True}, "a": {"group": "first_end"}, "b": {"group": "second_start"}},
        "contact_pair": [{"name": "faces", "first": "a", "second": "b", "direction": [1.0, 0.0, 0.0]}],
        "output": {"fields_every": 0},
    }
    tables["node_set"] |= {"base": {"nearest": [0.0, 0.0, 0.0]}, "last": {"nearest": [5.0, 0.0, 0.0]}}
    stages = [
        {"name": "press", "static": {"step": 0.5}, "support": [LINE, HELD, way]},
        {"name": "held", "time": FLY},
        {"name": "go", "time": {**FLY, "integrator": "newmark"}, "support": [LINE, HELD]},
    ]
    history = run(bar(stages, **tables))
    force = 0.5 * YOUNG * AREA * delta
    np.testing.assert_allclose(history["pair/faces/force"][2:203, 0], force, rtol=1e-8)
    assert history["pair/faces/impulse"][202, 0] == pytest.approx(force * 0.02, rel=1e-9)
    assert history["pair/faces/impulse"][-1, 0] > history["pair/faces/impulse"][202, 0]
    assert not history["pair/faces/force"][-1].any()
