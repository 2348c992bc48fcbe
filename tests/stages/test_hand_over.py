"""What goes from one stage to the next: data of bars by name, energies, and what has been dissipated, which stays."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import check_balances

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.columns import ENERGIES
from pfem_petsc.mechanics.bars import Bars

YOUNG, AREA = 1e6, 1e-3
POINTS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.1, 0.0]]
TWO_BARS = {
    "mesh": {
        "generator": "arrays",
        "points": POINTS,
        "bars": [[0, 1], [1, 2], [3, 1]],
        "bar_groups": {"inclined": [2]},
    },
    "node_set": {
        "left": {"indices": [0, 3]},
        "middle": {"indices": [1]},
        "tip": {"indices": [2]},
        "all": {"all": True},
    },
    "material": {
        "m": {"young_modulus": YOUNG, "density": 1000.0},
        "weak": {"young_modulus": YOUNG, "density": 1000.0},
    },
    "section": {
        "s": {"area": AREA, "material": "m"},
        "inclined": {"area": AREA, "material": "weak", "bars": "inclined"},
    },
    "support": [{"node_set": "left", "fix": "x"}, {"node_set": "all", "fix": "yz"}],
    "output": {"fields_every": 0},
}
FLY = {"integrator": "central_differences", "step": 1e-3, "end": 0.02}
CONNECTORS = {
    "spring": [{"between": ["middle", "tip"], "stiffness": 5.0}],
    "dashpot": [{"between": ["middle", "tip"], "coefficient": 0.1}],
}


def pull(force):
    return [{"node_set": "tip", "force": [force, 0.0, 0.0]}]


def case_of(stages, **tables):
    """Two bars in line, with a third from the side, on a line; the third one is of the material ``weak``."""
    data = TWO_BARS | {"stage": [{"name": f"st{k}"} | stage for k, stage in enumerate(stages)]}
    return Case.from_dict(data | tables, name="hand-over")


def weak(**keys):
    return {"material": {**TWO_BARS["material"], "weak": {"young_modulus": YOUNG, "density": 1000.0, **keys}}}


@pytest.fixture
def run(comm, shared_tmp_path):
    """The history; energies are balanced, and what is dissipated never falls."""

    def run(case):
        folder = shared_tmp_path / f"{len(list(shared_tmp_path.iterdir()))}"
        comm.Barrier()
        with Simulation(case, comm, output=folder, quiet=True) as simulation:
            simulation.run()
        with open_result(folder) as result:
            found = {name: result.history[name] for name in result.history}
        comm.Barrier()
        check_balances(found, 1e-12)
        lost = [one.name for one in ENERGIES if one.side == "lost" and one.name != "numerical_dissipation"]
        scale = max(np.abs(found[name]).max() for name in (*lost, "kinetic_energy", "elastic_energy", "external_work"))
        for name in (*lost, "plastic_heat"):
            assert np.diff(found[name]).min() > -1e-14 * scale, name
        return found

    return run


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("earlier", [{"static": {"step": 0.5}}, {"time": FLY}])
def test_bars_that_a_later_stage_removes_keep_their_data_beside_springs_and_dashpots(run, earlier):
    """The plastic work, and the energy that the removal sets free, are those of the case without the connectors."""
    removal = [{"bars": "inclined", "time": 0.004, "duration": 0.004}]
    plastic = {"yield_stress": 1000.0, "isotropic_hardening": 1e5}
    tables = weak(**plastic)
    tables["material"]["m"] = {**tables["material"]["m"], **plastic}
    stages = [{**earlier, "load": pull(3.0)}, {"time": FLY, "remove": removal}]
    alone = run(case_of(stages, **tables))
    softly = {"spring": [{**CONNECTORS["spring"][0], "stiffness": 1e-9}]}
    with_them = run(case_of(stages, **tables, **softly))
    assert alone["plastic_heat"][-1] > 1e-4 and alone["rupture_dissipation"][-1] > 1e-6
    for name in ("plastic_heat", "rupture_dissipation", "kinetic_energy"):
        np.testing.assert_allclose(with_them[name], alone[name], rtol=1e-7, atol=1e-12)
    run(case_of(stages, **tables, **CONNECTORS))


@pytest.mark.parallel
def test_data_of_bars_are_taken_by_name(comm, shared_tmp_path):
    case = case_of([{"static": {"step": 0.5}}], **weak(yield_stress=1000.0, rupture={"stress": 5000.0}))
    with Simulation(case, comm, output=shared_tmp_path, quiet=True, check_only=True) as simulation:
        bars: Bars = simulation.model.bars
        history = np.arange(len(bars.ends) * len(bars.kept_names), dtype=float).reshape(len(bars.ends), -1)
        bars.put_history(history)
        kept, names = bars.history(), bars.kept_names
        assert len(names) > 4
        bars.put_history(np.zeros_like(history))
        bars.put_history(kept[:, ::-1], names[::-1])
        np.testing.assert_array_equal(bars.history(), kept)


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_statics_takes_over_while_a_bar_breaks(run, steps, damping):
    """All that moved, and the work of the loads up to the equilibrium without the bar, is accounted for."""
    tables = weak(rupture={"stress": 1200.0, "steps": steps}, stiffness_damping=damping)
    stages = [{"time": FLY, "load": pull(1.0)}, {"static": {"step": 0.25}, "load": pull(4.0)}]
    found = run(case_of(stages, initial={"velocity": [0.5, 0.0, 0.0]}, **tables))
    assert found["broken_bars"][-1] == 1
    # two bars in line carry the load: the energies of the end are closed forms
    np.testing.assert_allclose(found["elastic_energy"][-1], 2 * 0.5 * 4.0**2 / (YOUNG * AREA), rtol=1e-9)
    supplied = found["kinetic_energy"][0] + found["external_work"][-1]
    lost = sum(found[f"{kind}_dissipation"][-1] for kind in ("rupture", "viscous", "numerical"))
    np.testing.assert_allclose(supplied - found["elastic_energy"][-1], lost, rtol=1e-12)


@pytest.mark.slow
def test_rest_length_of_a_broken_bar_changes_nothing(run):
    """It has dissipated what it had stored, whatever rest length a later stage gives it."""
    stages = [{"time": FLY, "load": pull(1.0)}, {"static": {"step": 0.25}, "load": pull(4.0)}]
    tables = weak(rupture={"stress": 1200.0}) | {"initial": {"velocity": [1.0, 0.0, 0.0]}}
    kept = run(case_of(stages, **tables))
    for rest in (0.9, [[0.0, 1.0], [0.5, 0.8]]):
        stages[1]["section"] = {"inclined": {"rest_length": rest}}
        found = run(case_of(stages, **tables))
        assert found["prestress_work"][-1] == pytest.approx(0.0, abs=1e-15)
        for name in ("rupture_dissipation", "elastic_energy", "external_work", "numerical_dissipation"):
            np.testing.assert_allclose(found[name], kept[name], rtol=1e-12, atol=1e-15)


def rod(stages, **material):
    """A bar of 1 m between two fixed nodes."""
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"all": {"all": True}},
            "material": {"m": {"young_modulus": YOUNG, "density": 1000.0, **material}},
            "section": {"s": {"area": AREA, "material": "m"}},
            "support": [{"node_set": "all", "fix": "xyz"}],
            "output": {"fields_every": 0},
            "stage": [{"name": f"st{k}"} | stage for k, stage in enumerate(stages)],
        },
        name="rod",
    )


def rest(value):
    return {"section": {"s": {"rest_length": value}}}


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_heat_of_a_bar_that_is_shortened_and_released(run, whole):
    """In one table or in three stages: heat is the integral of s_Y A r da over the rest length r, and nothing else."""
    shortest, back = 0.99, 0.9915
    plastic = {"yield_stress": 1000.0, "isotropic_hardening": 1e5}
    static = {"static": {"step": 1.0 / 256}}
    down = {**static, **rest([[0.0, 1.0], [1.0, shortest]])}
    up = {**static, **rest([[0.0, shortest], [1.0, back]])}
    if whole:
        one = {"static": {"step": 1.0 / 512, "max_step": 1.0 / 512}, **rest([[0, 1.0], [0.5, shortest], [1, back]])}
        found = run(rod([one], **plastic))
    else:
        found = run(rod([down, up, {**static, **rest(back)}], **plastic))
    strain = 1.0 / np.linspace(1.0, shortest, 100_001) - 1.0
    flow = np.maximum(YOUNG * strain - 1000.0, 0.0) / (YOUNG + 1e5)
    lengths = 1.0 / (1.0 + 0.5 * (strain[1:] + strain[:-1]))
    heat = 1000.0 * AREA * (lengths * np.diff(flow)).sum()
    np.testing.assert_allclose(found["plastic_heat"][-1], heat, rtol=2e-5)
    assert found["plastic_heat"].argmax() < 0.7 * len(found["plastic_heat"])  # and stays
    energy = found["elastic_energy"] + found["plastic_dissipation"] + found["numerical_dissipation"]
    np.testing.assert_allclose(found["prestress_work"] + found["external_work"], energy - energy[0], atol=1e-14)


@pytest.mark.parametrize("softening", [{}, {"softening": [[0.0, 1.0, 1.0], [100.0, 0.5, 0.5]]}])
def test_work_of_rest_lengths_and_temperatures_on_damped_bars(run, softening):
    """With the energy-momentum scheme nothing is dissipated but by the viscous stress, whose work is E beta e'^2."""
    beta, slow = 1e-3, 0.05
    material = {"stiffness_damping": beta, "thermal_expansion": 1e-5, **softening}
    time = {"integrator": "energy_momentum", "step": 1e-3, "end": 2 * slow}
    stage = {"time": time, "section": {"s": {"pretension": [[0.0, 0.0], [slow, 5.0]]}}}
    heat = [{"table": [[0.0, 0.0], [2 * slow, 50.0]]}]
    case = rod([stage], **material)
    found = run(case.copy({"temperature": heat, "solver": {"rtol": 1e-12}}))
    assert abs(found["numerical_dissipation"]).max() < 1e-12 * found["prestress_work"][-1]
    strain, length = 5.0 / (YOUNG * AREA), 1.0 / (1.0 + 5.0 / (YOUNG * AREA))
    rates = [(strain / slow - 1e-5 * 50.0 / (2 * slow)), -1e-5 * 50.0 / (2 * slow)]
    lost = YOUNG * beta * AREA * length * slow * sum(rate**2 for rate in rates)
    np.testing.assert_allclose(found["viscous_dissipation"][-1], lost, rtol=1e-2)
    modulus = 0.75 * YOUNG if softening else YOUNG
    elastic = 0.5 * modulus * (strain - 50.0e-5) ** 2 * AREA * length
    np.testing.assert_allclose(found["elastic_energy"][-1], elastic, rtol=1e-9)


@pytest.mark.parallel
def test_bar_that_is_removed_while_it_breaks_counts_as_broken(run):
    """The count of a stage, and of a continued run, is that of the states of the bars, and never falls."""
    breaking = weak(rupture={"stress": 1e-6, "steps": 30})
    removal = [{"bars": "inclined", "time": 0.01}]
    stages = [{"time": FLY, "load": pull(3.0), "remove": removal}, {"time": FLY}]
    broken = run(case_of(stages, **breaking))["broken_bars"]
    assert broken[0] == 0 and broken[-1] == 1 and np.diff(broken).min() == 0
