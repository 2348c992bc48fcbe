"""Temperatures: restrained and free bars, heating over time, and the work of heating in the ledger."""

import numpy as np
import pytest
from helpers.runs import run

from pfem_petsc import Case
from pfem_petsc.output.result import open_result

YOUNG, EXPANSION, LENGTH, AREA, DENSITY = 210e9, 1.2e-5, 2.0, 1e-4, 7850.0


def case(
    temperature, integrator="newmark", damping=0.0, ends=("start", "end"), step=1e-5, steps=20, strain="engineering"
):
    """A rod along x; its ends as asked held along x, all nodes held across."""
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": LENGTH, "elements": 4},
            "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
            "material": {
                "steel": {
                    "young_modulus": YOUNG,
                    "density": DENSITY,
                    "thermal_expansion": EXPANSION,
                    "damping": damping,
                    "strain": strain,
                }
            },
            "section": {"bar": {"area": AREA, "material": "steel"}},
            "support": [{"node_set": "all", "fix": "yz"}, *({"node_set": end, "fix": "x"} for end in ends)],
            "temperature": [temperature],
            "time": {"integrator": integrator, "step": step, "end": steps * step},
            "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
        }
    )


@pytest.mark.parametrize("integrator", ["newmark", "central_differences", "energy_momentum"])
def test_restrained_bar(integrator, shared_tmp_path, comm):
    heat = 80.0
    history = run(case({"value": heat}, integrator), shared_tmp_path)
    force = YOUNG * AREA * EXPANSION * heat
    assert history["probe/end/reaction"][-1, 0, 0] == pytest.approx(-force, rel=1e-12)
    assert history["kinetic_energy"].max() < 1e-24
    if comm.rank == 0:
        result = open_result(shared_tmp_path)
        assert result.field("stress", 1) == pytest.approx(np.full(4, -YOUNG * EXPANSION * heat), rel=1e-12)
        assert result.field("temperature", 1) == pytest.approx(np.full(4, heat))


@pytest.mark.parametrize("strain", ["engineering", "logarithmic"])
def test_free_expansion(strain, shared_tmp_path, comm):
    """Damped to rest, a free bar is stress free at the length that its temperature gives it."""
    heat = 50.0
    rate = np.pi / (2 * LENGTH) * np.sqrt(YOUNG / DENSITY)  # of the slowest mode, held at one end
    history = run(
        case({"value": heat}, damping=2 * rate * DENSITY, ends=("start",), step=2e-4, steps=400, strain=strain),
        shared_tmp_path,
    )
    stretch = EXPANSION * heat if strain == "engineering" else np.expm1(EXPANSION * heat)
    assert history["probe/end/position"][-1, 0, 0] - LENGTH == pytest.approx(LENGTH * stretch, abs=1e-12 * LENGTH)
    assert history["elastic_energy"][-1] < 1e-20 * history["elastic_energy"][0]


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["newmark", "central_differences", "chung_lee", "wilson", "energy_momentum"])
def test_heating_over_time(integrator, shared_tmp_path, comm):
    """A heated restrained bar: stress follows the table, and its elastic energy is the work of heating."""
    table = [[0.0, 0.0], [1e-4, 60.0]]
    history = run(case({"table": table}, integrator), shared_tmp_path)
    heat = np.interp(history["time"], [0.0, 1e-4], [0.0, 60.0])
    energy = 0.5 * YOUNG * AREA * LENGTH * (EXPANSION * heat) ** 2
    assert history["elastic_energy"] == pytest.approx(energy, rel=1e-11)
    assert history["thermal_work"] == pytest.approx(energy, rel=1e-11)
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * energy[-1]


def test_heating_a_free_bar(shared_tmp_path, comm):
    """Heat sets a free bar in motion; the ledger still closes."""
    history = run(
        case({"table": [[0.0, 0.0], [3e-5, 60.0]]}, "central_differences", ends=(), step=2e-5, steps=400),
        shared_tmp_path,
    )
    assert history["kinetic_energy"].max() > 0.01
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()


def held_bar(folder, comm, law, **tables):
    """A bar whose ends are held, heated over time or from a stage on."""
    material = {"young_modulus": 1e6, "density": 1e3, "thermal_expansion": 1e-4, **law}
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": {"every": {"all": True}},
        "material": {"it": material},
        "section": {"it": {"area": 1e-4, "material": "it"}},
        "support": [{"node_set": "every", "fix": "xyz"}],
        "output": {"fields_every": 0},
        **tables,
    }
    return run(Case.from_dict(data, source="bar.toml"), folder / "out", comm)


SHORT = {"integrator": "newmark", "step": 1e-3, "end": 2e-3}


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "lost"),
    [
        ({"law": "damage", "tensile_strength": 100.0, "fracture_energy": 0.05}, "damage_dissipation"),
        ({"rupture": {"stress": 100.0}}, "rupture_dissipation"),
    ],
)
def test_what_a_stage_damages_by_cooling_at_once_is_thermal_work(law, lost, comm, shared_tmp_path):
    stages = [{"time": SHORT}, {"time": SHORT, "temperature": [{"value": -2.0}]}]
    history = held_bar(shared_tmp_path, comm, law, stage=stages)
    assert history[lost][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * history["thermal_work"][-1]


def test_bars_that_soften_and_are_damped_in_proportion_to_stiffness_are_heated(comm, shared_tmp_path):
    """All in one: the modulus at the end is halved, and the force with it."""
    law = {"softening": [[0.0, 1.0, 1.0], [50.0, 0.5, 0.5]], "stiffness_damping": 1e-3}
    rows = [[0.0, 0.0], [1e-3, 50.0]]
    history = held_bar(shared_tmp_path, comm, law, time=SHORT, temperature=[{"table": rows}])
    assert history["elastic_energy"][-1] == pytest.approx(0.5 * 0.5e6 * (50.0 * 1e-4) ** 2 * 1e-4)
