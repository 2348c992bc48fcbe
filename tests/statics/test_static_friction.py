"""Coulomb friction in static increments against closed forms: sliders, chains of sliders, blocks on a rough floor."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import case_of

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import SimulationFailure

YOUNG, AREA = 1e8, 1e-4
STIFFNESS = YOUNG * AREA  # of bars of 1 m [N/m]
FRICTION, PRESS = 0.4, 25.0
STRENGTH = FRICTION * PRESS  # of a node that is pressed [N]
FLOOR = {"type": "plane", "name": "floor", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": FRICTION}
STEADY = [[0.0, 1.0], [1.0, 1.0]]  # of a load that is there from the start


def sliders(folder, comm, count, motion, static, press=(PRESS,), **tables):
    """Nodes on a rough floor in a row along x, joined by bars of 1 m; the last node is moved by a table."""
    points = [[float(k), 0.0, 0.0] for k in range(count + 1)]
    sets = {f"slider{k}": {"indices": [k]} for k in range(count)} | {
        "sliders": {"indices": list(range(count))},
        "hand": {"indices": [count]},
        "all": {"all": True},
    }
    loads = [
        {"node_set": f"slider{k}", "force": [0.0, 0.0, -press[k % len(press)]], "table": STEADY} for k in range(count)
    ]
    given = {
        "node_set": sets,
        "material": {"rope": {"young_modulus": YOUNG, "density": 1000.0}},
        "section": {"all": {"area": AREA, "material": "rope"}},
        "support": [
            {"node_set": "all", "fix": "y"},
            {"node_set": "hand", "fix": "z"},
            {
                "node_set": "hand",
                "fix": "x",
                "motion": [[t, d, 0.0, 0.0] for t, d in motion],
                "interpolation": "linear",
            },
        ],
        "load": loads,
        "wall": [FLOOR | {"node_set": "sliders"}],
        "static": static,
        "solver": {"rtol": 1e-12},
        "output": {
            "fields_every": 0,
            "probe": [{"name": "hand", "node_set": "hand"}, {"name": "sliders", "node_set": "sliders"}],
        },
    } | tables
    return case_of(folder, comm, points, [[k, k + 1] for k in range(count)], **given)


def history_of(case, comm, folder, **options):
    with Simulation(case, comm, output=folder / "out", quiet=True, **options) as simulation:
        simulation.run()
    history = open_result(folder / "out" / "result.vtkhdf").history
    return {name: history[name] for name in history}


def play(place, play):
    """Positions of a slider that is pushed when it is ``play`` behind or ahead of ``place`` (n,): a play operator."""
    out, x = [], 0.0
    for at in place:
        x = min(max(x, at - play), at + play)
        out.append(x)
    return np.array(out)


TO_AND_FRO = [[0.0, 0.0], [0.25, 0.004], [0.75, -0.003], [1.0, 0.001]]


@pytest.mark.parallel
@pytest.mark.parametrize("step", [0.05, 0.025])
def test_a_slider_pulled_to_and_fro_by_a_spring(shared_tmp_path, comm, step):
    """It sticks until the spring pulls with mu N and follows then: a play operator, whatever the increments."""
    history = history_of(sliders(shared_tmp_path, comm, 1, TO_AND_FRO, {"step": step}), comm, shared_tmp_path)
    factor = history["load_factor"]
    hand = np.interp(factor, *np.transpose(TO_AND_FRO))
    expected = play(hand, STRENGTH / STIFFNESS)
    x = history["probe/sliders/position"][:, 0, 0]
    np.testing.assert_allclose(x, expected, atol=1e-12)
    assert np.ptp(x) > 1e-3
    pull = STIFFNESS * (hand - expected)
    np.testing.assert_allclose(history["wall/floor/force"][1:, 0], -pull[1:], atol=1e-8 * STRENGTH)
    np.testing.assert_allclose(history["wall/floor/force"][1:, 2], PRESS, rtol=1e-9)
    lost = STRENGTH * np.abs(np.diff(expected, prepend=0.0)).cumsum()
    np.testing.assert_allclose(history["friction_dissipation"], lost, atol=1e-9 * lost[-1])
    assert abs(history["energy_imbalance"]).max() < 1e-10 * lost[-1]


def test_slip_spreads_along_a_chain_of_sliders(shared_tmp_path, comm):
    """Those nearest to the hand slip first: the pull on each is what the ones between have left of it.

    With m sliders slipping, of N_k each, bar k pulls with F - sum of mu N of those nearer to the hand, and the hand has
    moved by sum of (those pulls)/k. Sliders that stick have not moved at all.
    """
    press = (40.0, 10.0, 25.0, 15.0, 30.0)
    motion = [[0.0, 0.0], [1.0, 0.02]]
    case = sliders(shared_tmp_path, comm, 5, motion, {"step": 0.04}, press=press)
    history = history_of(case, comm, shared_tmp_path)
    strength = FRICTION * np.array(press)[::-1]  # from the hand on
    for row, factor in enumerate(history["load_factor"]):
        moved = 0.02 * factor
        # pulls of the bars if m sliders slip: F - (0, s1, s1 + s2, ...); the last one does not exceed what sticks
        for m in range(6):
            taken = np.concatenate([[0.0], strength[:m].cumsum()])[: min(m, 4) + 1]
            pull = (STIFFNESS * moved + taken.sum()) / len(taken) - taken
            sticks = m == 5 or pull[-1] <= strength[m] + 1e-9
            if sticks:
                break
        if m == 5:  # all slip: the pull is the whole strength, and the sliders follow as a body
            pull = strength.sum() - np.concatenate([[0.0], strength.cumsum()])[:5]
        expected = moved - pull.cumsum() / STIFFNESS
        expected = np.concatenate([expected, np.zeros(5)])[:5]
        x = history["probe/sliders/position"][row, :, 0] - np.arange(5.0)
        np.testing.assert_allclose(x[::-1], expected, atol=1e-11)
    assert x[0] > 1e-3
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["friction_dissipation"][-1]


@pytest.mark.slow
def test_a_static_coefficient_holds_until_it_breaks(shared_tmp_path, comm):
    """Pulled steadily, a slider with mu_s > mu jerks: it holds to mu_s N and slips until the spring has mu N."""
    motion = [[0.0, 0.0], [1.0, 0.006]]
    floor = FLOOR | {"node_set": "sliders", "static_friction": 2.0 * FRICTION}
    case = sliders(shared_tmp_path, comm, 1, motion, {"step": 0.01}, wall=[floor])
    history = history_of(case, comm, shared_tmp_path)
    hand, x, expected = 0.006 * history["load_factor"], 0.0, []
    for at in hand:
        if STIFFNESS * (at - x) > 2.0 * STRENGTH * (1 + 1e-12):
            x = at - STRENGTH / STIFFNESS
        expected.append(x)
    np.testing.assert_allclose(history["probe/sliders/position"][:, 0, 0], expected, atol=1e-11)
    assert len(set(np.round(expected, 9))) > 3


def block(static, **tables):
    """Octet cells on a rough floor, on which nodes weigh 1 N each."""
    return Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [2, 2, 1], "pitch": 0.1},
            "node_set": {"all": {"all": True}, "bottom": {"group": "bottom"}, "top": {"group": "top"}},
            "material": {"m": {"young_modulus": 1e8, "density": 1000.0}},
            "section": {"s": {"area": 1e-4, "material": "m"}},
            "load": [{"node_set": "all", "force": [0.0, 0.0, -1.0], "table": STEADY}],
            "wall": [FLOOR],
            "static": static,
            "solver": {"rtol": 1e-12},
            "output": {"fields_every": 0},
        }
        | tables
    )


WEIGHT = 38.0  # of the nodes of a block [N]; 13 of them are at the bottom


def pushed(force):
    """Loads of a block on a floor that are too small to tip it [N], growing with the load factor."""
    load = {"node_set": "bottom", "force": [force / 13.0, 0.0, 0.0]}
    return {"load": [{"node_set": "all", "force": [0.0, 0.0, -1.0], "table": STEADY}, load]}


@pytest.mark.slow
@pytest.mark.parallel
def test_a_block_that_friction_alone_holds_sticks(shared_tmp_path, comm):
    """No support holds it: the stiffness is singular until nodes press on the floor."""
    push = 0.7 * FRICTION * WEIGHT
    history = history_of(block({"step": 0.25}, **pushed(push)), comm, shared_tmp_path)
    expected = np.outer(history["load_factor"][1:], [-push, 0.0, 0.0]) + [0.0, 0.0, WEIGHT]
    np.testing.assert_allclose(history["wall/floor/force"][1:], expected, atol=1e-8 * WEIGHT)
    moved = history["centre_of_mass"] - history["centre_of_mass"][0]
    assert abs(moved).max() < 1e-5
    assert abs(history["energy_imbalance"]).max() < 1e-10 * history["elastic_energy"][-1]


@pytest.mark.slow
def test_a_block_that_slips_has_no_equilibrium(shared_tmp_path, comm):
    """It is refused beyond mu N and told why; a viscous force carries it on, against friction of mu N."""
    push = 2.0 * FRICTION * WEIGHT
    with pytest.raises(SimulationFailure, match="no equilibrium found beyond load factor 0.*friction"):
        history_of(block({"step": 0.1, "min_step": 0.04}, **pushed(push)), comm, shared_tmp_path)
    history = open_result(shared_tmp_path / "out" / "result.vtkhdf").history
    assert 0.4 <= history["load_factor"][-1] <= 0.5
    viscous = block({"step": 0.1, "stabilise": 1e-3}, **pushed(push))
    with pytest.raises(SimulationFailure, match="no equilibrium nearby without it"):
        history_of(viscous, comm, shared_tmp_path / "viscous")
    history = open_result(shared_tmp_path / "viscous" / "out" / "result.vtkhdf").history
    force = history["wall/floor/force"][history["load_factor"] > 0.65]
    assert len(force) > 1
    np.testing.assert_allclose(force[:, 0], -FRICTION * force[:, 2], rtol=0.01)


def rod_between_walls(folder, comm, elements, fix, friction):
    """Nothing holds it before it touches both walls, one of which moves by 1 % of its length."""
    sides = [("left", [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.0), ("right", [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], -0.01)]
    walls = [
        {"name": name, "type": "plane", "point": point, "normal": normal, "friction": friction}
        | {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, way, 0.0, 0.0]], "interpolation": "linear"}
        for name, point, normal, way in sides
    ]
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": elements},
        "node_set": {"all": {"all": True}},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "support": [{"node_set": "all", "fix": fix}] if fix else [],
        "wall": walls,
        "static": {"step": 0.25},
        "output": {"fields_every": 0},
    }
    return history_of(Case.from_dict(data), comm, folder)


@pytest.mark.parametrize(("elements", "fix", "friction"), [(4, "yz", 0.0), (1, "", 0.2)])
def test_a_rod_that_two_walls_hold(shared_tmp_path, comm, elements, fix, friction):
    """E A times the shortening, from the walls alone; across them supports hold the rod, or friction does."""
    history = rod_between_walls(shared_tmp_path, comm, elements, fix, friction)
    for name, sign in (("left", 1.0), ("right", -1.0)):
        force = np.outer(sign * 100.0 * history["load_factor"], [1.0, 0.0, 0.0])
        np.testing.assert_allclose(history[f"wall/{name}/force"], force, atol=1e-6)


def test_a_rod_that_nothing_holds_along_walls_is_told_what_would(shared_tmp_path, comm):
    with pytest.raises(SimulationFailure, match="walls without friction do not hold nodes along them: add supports"):
        rod_between_walls(shared_tmp_path, comm, 3, "z", 0.0)


def test_a_free_rod_between_another_rod_and_a_wall(shared_tmp_path, comm):
    """The first rod closes a gap of 2 mm, pushes the second one over 3 mm onto the wall, and both shorten."""
    data = {
        "mesh": {"generator": "two_rods", "length": 1.0, "elements": 2, "gap": 0.002},
        "node_set": {
            "all": {"all": True},
            **{name: {"group": name} for name in ("start", "first_end", "second_start")},
        },
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "support": [
            {"node_set": "all", "fix": "yz"},
            {"node_set": "start", "fix": "x", "interpolation": "linear", "motion": [[0, 0, 0, 0], [1, 0.02, 0, 0]]},
        ],
        "contact_pair": [{"name": "ends", "first": "first_end", "second": "second_start", "direction": [1.0, 0, 0]}],
        "wall": [{"name": "stop", "type": "plane", "point": [2.005, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}],
        "static": {"step": 0.125},
        "output": {"fields_every": 0},
    }
    history = history_of(Case.from_dict(data), comm, shared_tmp_path)
    force = 0.5 * 1e4 * np.maximum(0.02 * history["load_factor"] - 0.005, 0.0)
    np.testing.assert_allclose(history["pair/ends/force"][:, 0], force, atol=1e-6)
    np.testing.assert_allclose(history["wall/stop/force"][:, 0], -force, atol=1e-6)
