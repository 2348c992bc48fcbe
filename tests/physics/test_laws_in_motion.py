"""Cables, struts, damage and compaction in motion: integrators, fused steps, restarts, ranks, strain measures."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import run
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case

YOUNG = 1e7
MATERIALS = {
    "cable": {"yield_stress": 1e5, "isotropic_hardening": 1e5},
    "strut": {"yield_stress": 1e5, "imperfection": 1e-3},
    "damage": {"tensile_strength": 1e5, "fracture_energy": 3e3},
    "compaction": {
        "yield_stress": 1e5,
        "kinematic_hardening": 1e5,
        "compaction_strain": 0.02,
        "compaction_modulus": 3e7,
    },
}
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, 1.1], [1.1, 0.9, 1.0], [0.5, 0.4, 2.1]])
BARS = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3], [1, 4], [2, 4], [3, 4], [3, 5], [4, 5], [2, 5], [1, 5]]
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}  # the trapezoidal rule
GROUPS = {"cable": [7, 11, 12], "strut": [3, 4, 9], "damage": [5, 6], "compaction": [8, 10]}


def material(law, **more):
    return {"law": law, "young_modulus": YOUNG, "density": 1000.0, **MATERIALS[law], **more}


@pytest.fixture
def tower(comm, shared_tmp_path):
    """A tower of bars of all laws and elastic ones, which is thrown; gives its case."""
    if comm.rank == 0:
        import h5py

        with h5py.File(shared_tmp_path / "mesh.h5", "w") as file:
            file["points"], file["bars"] = POINTS, np.array(BARS)
            for name, members in GROUPS.items():
                file[f"bar_groups/{name}"] = np.array(members)
    comm.Barrier()

    def case(integrator="newmark", step=2e-3, steps=150, strain="engineering", output=None, **solver):
        return Case.from_dict(
            {
                "mesh": {"file": "mesh.h5"},
                "node_set": {"feet": {"indices": [0, 1, 2]}, "top": {"indices": [3, 4, 5]}},
                "material": {"elastic": {"young_modulus": YOUNG, "density": 1000.0}}
                | {law: material(law, strain=strain) for law in MATERIALS},
                "section": {"rest": {"area": 1e-3, "material": "elastic"}}
                | {law: {"area": 1e-3, "material": law, "bars": law} for law in MATERIALS}
                | {"strut": {"area": 1e-3, "material": "strut", "bars": "strut", "shape": "tube", "thickness": 5e-3}},
                "initial": {"on": [{"node_set": "top", "velocity": [3.0, 1.0, -4.0]}]},
                "support": [{"node_set": "feet", "fix": "xyz"}],
                "time": {"integrator": integrator, "step": step, "end": step * steps, **PARAMETERS.get(integrator, {})},
                "solver": solver,
                "output": {"fields_every": 50, "checkpoint_every": 30, **(output or {})},
            },
            folder=shared_tmp_path,
        )

    return case


SCHEMES = {  # by default without batches, whose loops take long to compile for each law
    "chung_lee": {},
    "newmark": {},
    "generalized_alpha": {},
    "energy_momentum": {},
    "matrix-free": {"integrator": "newmark", "operator": "matrix_free", "linear": "cg"},
    "central_differences": {},
}


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("scheme", SCHEMES)
def test_tower_of_all_laws(scheme, tower, comm, shared_tmp_path):
    """Energies balance, everything happens, and the fine solution is the same."""
    keys = {"integrator": scheme} | SCHEMES[scheme]
    history = run(tower(**keys), shared_tmp_path / "out", comm)
    energy = history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-7 * energy
    if scheme == "energy_momentum":
        assert np.abs(history["numerical_dissipation"]).max() < 1e-7 * energy  # the solver's tolerance
    for name in ("plastic_heat", "damage_dissipation"):
        assert (np.diff(history[name]) >= -1e-12 * energy).all() and history[name][-1] > 1e-3 * energy
    assert history["slack_bars"].max() >= 2 and history["slack_bars"].min() == 0
    reference = run(tower("chung_lee", 2e-4, 1500), shared_tmp_path / "fine", comm)
    assert history["plastic_heat"][-1] == pytest.approx(reference["plastic_heat"][-1], rel=0.1)
    assert history["damage_dissipation"][-1] == pytest.approx(reference["damage_dissipation"][-1], rel=0.1)


def row_of_bars(law, strain, velocity, steps=200, integrator="central_differences", elements=1):
    time = {"integrator": integrator, "step": 1e-3, "end": 1e-3 * steps, **PARAMETERS.get(integrator, {})}
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0 * elements, "elements": elements},
            "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [elements]}, "all": {"all": True}},
            "material": {"it": material(law, strain=strain)},
            "section": {"it": {"area": 1e-3, "material": "it", "shape": "round"}},
            "initial": {"on": [{"node_set": "tip", "velocity": [velocity, 0.0, 0.0]}]},
            "support": [{"node_set": "foot", "fix": "x"}, {"node_set": "all", "fix": "yz"}],
            "time": time,
            # MUMPS, which small models take on several ranks, repeats to rounding only
            "solver": {"linear": "cg"} if integrator != "central_differences" else {},
            "output": {"fields_every": 50, "checkpoint_every": 30},
        }
    )


THROWN = {("cable", "engineering"): 3.0, ("strut", "green"): -3.0, ("damage", "logarithmic"): 3.0}
THROWN |= {("compaction", "engineering"): -4.0}


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("law", MATERIALS)
def test_heat_that_comes_and_goes_balances(law, comm, shared_tmp_path):
    """Work of changing temperatures on bars that yield, buckle, soften and are slack, with a scheme that conserves."""
    velocity = 3.0 if law in ("cable", "damage") else -3.0
    data = row_of_bars(law, "engineering", velocity, 100, "energy_momentum", elements=2).to_dict()
    data["material"]["it"]["thermal_expansion"] = 1e-4
    data["temperature"] = [{"table": [[0.0, 0.0], [0.03, 60.0], [0.06, -60.0], [0.1, 30.0]]}]
    data["solver"] = {"rtol": 1e-13}
    history = run(Case.from_dict(data), shared_tmp_path / "out", comm)
    energy = history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * energy
    assert np.abs(history["numerical_dissipation"]).max() < 1e-11 * energy
    assert np.abs(history["thermal_work"]).max() > 1e-3 * energy
    assert max(history["plastic_heat"][-1], history["damage_dissipation"][-1]) > 1e-3 * energy


RESTARTED = [("damage", "energy_momentum"), ("cable", "newmark"), ("compaction", "newmark")]
RESTARTED += [("strut", "central_differences"), ("cable", "central_differences"), ("strut", "energy_momentum")]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("law", "integrator"), RESTARTED)
def test_restart_is_bitwise(law, integrator, comm, shared_tmp_path):
    """A row of bars whose tip is thrown; the first run ends between snapshots."""
    velocity = 6.0 if law in ("cable", "damage") else -6.0
    last = assert_restart_is_bitwise(
        row_of_bars(law, "engineering", velocity, 150, integrator, elements=5), comm, shared_tmp_path, 75
    )
    assert max(last["plastic_heat"][-1], last["damage_dissipation"][-1]) > 1e-3 * last["kinetic_energy"][0]
