"""Bars that break: waves, energies, integrators, ranks, restarts."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import AREA, DENSITY, MATERIAL, SPEED, YOUNG, chain
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Simulation
from pfem_petsc.errors import InputError

EXPLICIT = {"integrator": "central_differences"}
INTEGRATORS = {
    "central_differences": {},
    "central_differences, consistent": {"mass": "consistent"},
    "houbolt": {},
    "newmark": {"beta": 0.25, "gamma": 0.5},
    "wilson": {},
    "chung_lee": {},
    "souza_moura": {},
    "hulbert_chung": {},
    "energy_momentum": {},
    "generalized_alpha": {},
}


def taut(folder, comm, elements, strain=1e-3, **tables):
    """A chain between fixed ends, taut by cooling, whose middle bar breaks at the start, and its time step [s]."""
    end = {"both": {"indices": [0, elements]}}
    material = {"it": {**MATERIAL, "thermal_expansion": 1e-5}}
    material["weak"] = {**material["it"], "rupture": {"stress": 0.99 * YOUNG * strain}}
    step = 0.2 / elements / SPEED
    case = chain(
        folder,
        comm,
        elements,
        [elements // 2],
        {"stress": 1.0},
        {**EXPLICIT, "step": step, "end": 0.45 / SPEED},
        material=material,
        node_set={**end, "lip": {"indices": [elements // 2]}},
        support=[{"node_set": "both", "fix": "xyz"}],
        temperature=[{"value": -strain / 1e-5}],
        output={"fields_every": 0, "probe": [{"name": "lip", "node_set": "lip"}]},
        **tables,
    )
    return case, strain


@pytest.mark.parallel
def test_a_taut_chain_that_breaks_releases_its_energy_and_a_wave(comm, shared_tmp_path):
    """Behind the wave of speed c from the break bars are slack, and nodes move at c e: the lip by c e t."""
    elements = 101
    case, strain = taut(shared_tmp_path, comm, elements)
    history = run(case, shared_tmp_path / "out", comm)
    assert set(history["broken_bars"]) == {1}
    released = 0.5 * YOUNG * strain**2 * AREA / elements
    np.testing.assert_allclose(history["rupture_dissipation"], released, rtol=1e-12)
    total = 0.5 * YOUNG * strain**2 * AREA
    assert history["elastic_energy"][0] == pytest.approx(total - released, rel=1e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * total
    moved = history["probe/lip/position"][0, 0, 0] - history["probe/lip/position"][:, 0, 0]
    # the lip has the whole mass of a node, half of it of the broken bar, and starts later by half a bar's wave time
    late = 0.5 / elements / SPEED
    at = history["time"] > 0.25 / SPEED
    np.testing.assert_allclose(moved[at], strain * SPEED * (history["time"][at] - late), rtol=0.01)
    # what the wave has passed is at rest in strain and moves: of two halves each c t
    passed = 2.0 * SPEED * (history["time"][at] - late)
    kinetic = 0.5 * DENSITY * AREA * (strain * SPEED) ** 2 * passed
    np.testing.assert_allclose(history["kinetic_energy"][at], kinetic, rtol=0.01)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_integrators_break_the_same_bar_at_the_same_time(name, comm, tmp_path):
    """A rod under a step load F at its tip: the wave F/A arrives at the foot at L/c, and doubles there."""
    elements, force = 40, 1e-4 * YOUNG * AREA
    scheme = {"integrator": name.split(",")[0], **INTEGRATORS[name]}
    case = chain(
        tmp_path,
        comm,
        elements,
        [0, 5],
        {"stress": 1.5e-4 * YOUNG},
        {**scheme, "step": 0.2 / elements / SPEED, "end": 1.35 / SPEED},
        load=[{"node_set": "tip", "force": [force, 0.0, 0.0]}],
        solver={"rtol": 1e-11},
    )
    history = run(case, tmp_path / "out", comm)
    at = np.argmax(history["broken_bars"] > 0)
    assert history["time"][at] * SPEED == pytest.approx(1.02, abs=0.05)
    told = [line for line in (tmp_path / "out" / "log.txt").read_text().splitlines() if "broke at" in line]
    assert "bar 0 broke at" in told[0]
    scale = history["external_work"].max()
    assert np.abs(history["energy_imbalance"]).max() < 1e-8 * scale
    # the bar held at least what the limit says
    least = 0.5 * (1.5e-4) ** 2 * YOUNG * AREA / elements
    assert least < history["rupture_dissipation"][at] < 2.0 * least
    if name == "energy_momentum":
        assert np.abs(history["numerical_dissipation"]).max() < 1e-8 * scale


def pulled(folder, comm, **tables):
    """A rod of ten bars of two materials that all stretch at 40/s in the beginning, until they break."""
    time = {**EXPLICIT, "step": 1e-5, "end": 3e-3}
    limits = {"plastic_strain": 2e-3, "steps": 3}
    sets = {f"n{k}": {"indices": [k]} for k in range(1, 11)}
    plastic = {**MATERIAL, "yield_stress": 2e6, "isotropic_hardening": 1e8}
    case = chain(
        folder,
        comm,
        10,
        [3, 7],
        {"stress": 1.0},
        tables.pop("time", time),
        material={"it": {**plastic, "rupture": limits}, "weak": {**MATERIAL, "rupture": {"stress": 3.5e6}}},
        node_set={"foot": {"indices": [0]}, **sets},
        initial={"on": [{"node_set": f"n{k}", "velocity": [4.0 * k, 0.0, 0.0]} for k in range(1, 11)]},
        **tables,
    )
    return case


@pytest.mark.parallel
def test_ranks_break_the_same_bars(comm, shared_tmp_path):
    """All bars of a rod can break; one rank breaks the same ones in the same steps."""
    case = pulled(shared_tmp_path, comm)
    whole = run(case, shared_tmp_path / "all", comm)
    texts = (shared_tmp_path / "all" / "log.txt").read_text().splitlines()
    assert whole["broken_bars"][-1] > 1
    assert sum("broke at step" in line for line in texts) == whole["broken_bars"][-1]
    assert_as_on_one_rank(whole, case, comm, shared_tmp_path, "broken_bars", "rupture_dissipation", within=1e-12)
    assert np.abs(whole["energy_imbalance"]).max() < 1e-12 * whole["kinetic_energy"][0]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_restarts_are_bitwise_before_at_and_after_a_break(scheme, comm, tmp_path):
    case = pulled(tmp_path, comm, time={"integrator": scheme, "step": 1e-5, "end": 6e-4})
    breaks = np.flatnonzero(np.diff(run(case, tmp_path / "first", comm)["broken_bars"])) + 1
    assert len(breaks) >= 2
    assert_restart_is_bitwise(case, comm, tmp_path, breaks[0] - 1, breaks[0], breaks[0] + 1, breaks[1])


def test_the_energy_of_elastoplastic_bars_stays_balanced_while_they_let_go(comm, tmp_path):
    """Heat and hardening of broken bars stay; nothing is counted twice while the force decreases over three steps."""
    history = run(pulled(tmp_path, comm), tmp_path / "out", comm)
    assert history["broken_bars"][-1] > 1
    for name in ("plastic_heat", "hardening_energy", "rupture_dissipation"):
        assert np.diff(history[name]).min() >= 0.0, name
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * history["kinetic_energy"][0]
    assert np.abs(history["numerical_dissipation"]).max() < 0.05 * history["kinetic_energy"][0]


def test_the_last_force_of_a_bar_does_not_depend_on_others_that_are_short(comm, tmp_path):
    """A row of bars that are pressed to less than their length by a fifth, and then break under that stress."""
    free = {f"n{k}": {"indices": [k]} for k in range(1, 6)}
    case = chain(
        tmp_path,
        comm,
        5,
        [2, 3],
        {"compressive_strain": 0.15, "steps": 1},
        {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 2e-5, "end": 2e-3},
        node_set={"foot": {"indices": [0]}, **free},
        initial={"on": [{"node_set": f"n{k}", "velocity": [-60.0 * k, 0.0, 0.0]} for k in range(1, 6)]},
        solver={"rtol": 1e-12},
    )
    history = run(case, tmp_path / "out", comm)
    assert history["broken_bars"][-1] >= 1
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * history["kinetic_energy"][0]


SHRINKING = {
    "central_differences": {"step": 2e-5},
    "newmark": {"step": 1e-3, "beta": 0.25, "gamma": 0.5},
    "energy_momentum": {"step": 1e-3},
}


@pytest.mark.parametrize("integrator", SHRINKING)
def test_a_bar_may_shrink_to_nothing_after_it_broke(integrator, comm, tmp_path):
    """A bar breaks under compression at the start, and its loose nodes fly on through the foot: no force, no guard."""
    case = chain(
        tmp_path,
        comm,
        2,
        [0],
        {"compressive_stress": 100.0},
        {"integrator": integrator, "end": 0.08, **SHRINKING[integrator]},
        length=0.2,
        material={
            "it": {**MATERIAL, "thermal_expansion": 1e-5},
            "weak": {
                **MATERIAL,
                "thermal_expansion": 1e-5,
                "strain": "logarithmic",
                "rupture": {"compressive_stress": 100.0},
            },
        },
        temperature=[{"bars": "weak", "value": 0.02}],
        initial={"velocity": [-2.0, 0.0, 0.0]},
    )
    simulation = Simulation(case, comm, output=tmp_path / "out", quiet=True)
    simulation.run()
    assert simulation.row["broken_bars"] == 1
    # with the velocity that they began with
    np.testing.assert_allclose(simulation.state.position[1:, 0], [0.1 - 0.16, 0.2 - 0.16], atol=2e-4)


@pytest.mark.parametrize(
    "rupture, told",
    [
        ({}, "expected at least one limit"),
        ({"plastic_strain": 0.1}, "the law elastic has no plastic strain"),
        ({"damage": 0.1}, "the law elastic has no damage"),
        ({"stress": -1.0}, "material.weak.rupture.stress"),
        ({"stres": 1.0}, "stres"),
        ({"stress": 1.0, "steps": 0}, "steps"),
    ],
)
def test_limits_that_make_no_sense_are_refused(rupture, told, comm, tmp_path):
    with pytest.raises(InputError, match=told):
        chain(tmp_path, comm, 2, [0], rupture, {**EXPLICIT, "step": 1e-5, "end": 1e-3})
