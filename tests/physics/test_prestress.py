"""Prescribed rest lengths of bars: force in the mesh, mass, gradual stressing, and its work."""

import numpy as np
import pytest
from helpers.cables import AREA, DENSITY, LENGTH, YOUNG, cell, fan, rod
from helpers.runs import run

from pfem_petsc import Simulation, open_result
from pfem_petsc.mechanics.elements import MEASURES
from pfem_petsc.mechanics.materials.base import law_of
from pfem_petsc.mechanics.rest_lengths import stretch_of

STRAINS = ["engineering", "green", "logarithmic"]
INTEGRATORS = [
    *("central_differences", "chung_lee", "energy_momentum", "generalized_alpha", "houbolt", "hulbert_chung"),
    *("newmark", "souza_moura", "wilson"),
]
RAMP = [[0.0, 0.0], [1e-3, 1500.0]]


@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("section", [{"pretension": 4e3}, {"pretension": -4e3}, {"prestress": 4e7}])
def test_force_in_the_mesh(section, strain, shared_tmp_path, comm):
    """2 % of strain: the force, or the stress, is the given one, and the mass that of the mesh."""
    history = run(rod(section, {"strain": strain}), shared_tmp_path)
    key, name = ("prestress", "stress") if "prestress" in section else ("pretension", "axial_force")
    assert cell(shared_tmp_path, comm, name) == pytest.approx([section[key]] * 2, rel=1e-13)
    assert np.abs(history["kinetic_energy"]).max() < 1e-20
    force = cell(shared_tmp_path, comm, "axial_force")
    assert history["probe/all/reaction"][-1, :, 0] == pytest.approx([-force[0], 0.0, force[0]], rel=1e-12, abs=1e-8)
    with Simulation(rod(section), comm, output=shared_tmp_path / "mass", quiet=True) as simulation:
        assert simulation.model.total_mass == pytest.approx(DENSITY * AREA * LENGTH, rel=1e-14)


@pytest.mark.parametrize("strain", STRAINS)
def test_rest_length_is_that_of_a_mesh_with_this_length(strain, tmp_path):
    """A mesh of the rest length, stretched by its supports, has the same force and energy."""
    factor = 0.96
    rest = run(rod({"rest_length": factor}, {"strain": strain}), tmp_path / "rest")
    pull = {"node_set": "end", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, LENGTH * (1.0 - factor), 0.0, 0.0]]}
    supports = [{"node_set": "all", "fix": "yz"}, {"node_set": "start", "fix": "x"}, pull]
    mesh = {"generator": "rod", "length": factor * LENGTH, "elements": 2}
    stretched = rod({}, {"strain": strain}, mesh=mesh, support=supports, static={"step": 0.5})
    pulled = run(stretched, tmp_path / "pulled")
    for name in ("axial_force", "stress", "strain"):
        found = [open_result(tmp_path / folder).field(name, at) for folder, at in (("rest", 0), ("pulled", -1))]
        np.testing.assert_allclose(*found, rtol=1e-12, err_msg=name)
    assert pulled["elastic_energy"][-1] == pytest.approx(rest["elastic_energy"][0], rel=1e-12)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_frequency_of_a_mass_between_two_pretensioned_bars(mass, shared_tmp_path, comm):
    """Across: k = 2 N/l; along: k = 2 (E A/l0), with the rest length l0 = l/(1 + N/(E A))."""
    force, half = 2500.0, LENGTH / 2.0
    ends = [{"node_set": end, "fix": "xyz"} for end in ("start", "end")]
    case = rod({"pretension": force}, support=ends, modes={"count": 3, "mass": mass}, static={"step": 1.0})
    run(case, shared_tmp_path)
    inertia = DENSITY * AREA * half * (1.0 if mass == "lumped" else 2.0 / 3.0)
    along = 2.0 * YOUNG * AREA * (1.0 + force / (YOUNG * AREA)) / half
    expected = np.sqrt(np.array([2.0 * force / half, 2.0 * force / half, along]) / inertia) / (2.0 * np.pi)
    assert open_result(shared_tmp_path).modes.frequency == pytest.approx(expected, rel=1e-10)


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["newton", "relaxation", "arc_length"])
def test_gradual_stressing_ends_where_sudden_stressing_does(method, shared_tmp_path, comm):
    rows = [[0.0, 0.0], [2.0, 6000.0]]  # beyond the end: a path needs a load that changes there
    newton = {"static": {"step": 1.0}}
    whole = run(fan(shared_tmp_path, comm, 3000.0, **newton), shared_tmp_path / "whole")
    keys = {"end": 1.0, "max_points": 60} if method == "arc_length" else {}
    gradual = fan(shared_tmp_path, comm, rows, static={"method": method, "step": 0.25, **keys})
    history = run(gradual, shared_tmp_path / "gradual")
    found = [each["probe/knot/position"][-1, 0] for each in (whole, history)]
    assert np.linalg.norm(found[0]) > 1e-3
    np.testing.assert_allclose(*found, atol=1e-9)
    assert history["elastic_energy"][-1] == pytest.approx(whole["elastic_energy"][-1], rel=1e-8)
    assert history["elastic_energy"][0] == 0.0
    assert history["prestress_work"][-1] == pytest.approx(history["elastic_energy"][-1], rel=0.05)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("strain", STRAINS)
def test_work_of_stressing_a_restrained_bar(integrator, strain, tmp_path):
    """Nothing moves, so that all of the elastic energy is the work of stressing."""
    time = {"integrator": integrator, "end": 1e-3}
    history = run(rod({"pretension": RAMP}, {"strain": strain}, time=time), tmp_path)
    energy = history["elastic_energy"]
    assert energy[-1] == pytest.approx(0.5 * 1500.0**2 / (YOUNG * AREA) * LENGTH, rel=0.03)
    np.testing.assert_allclose(history["prestress_work"], energy, rtol=1e-11, atol=1e-12 * energy[-1])
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * energy[-1]
    assert open_result(tmp_path).field("axial_force", -1) == pytest.approx([1500.0] * 2, rel=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_balance_while_stressing_moves_nodes(integrator, shared_tmp_path, comm):
    time = {"integrator": integrator, "end": 4e-3, "step": 1e-4}
    case = rod({"pretension": RAMP}, {"damping": 2e4}, ends=("start",), time=time)
    history = run(case, shared_tmp_path)
    scale = history["prestress_work"][-1]
    assert history["kinetic_energy"].max() > 0.05 * scale > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * scale


@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("plastic", [False, True])
def test_energy_momentum_conserves_energy_while_stressing(strain, plastic, tmp_path):
    material = {"strain": strain, "thermal_expansion": 1e-5}
    if plastic:
        material |= {"yield_stress": 1.6e7, "kinematic_hardening": 2e8, "isotropic_hardening": 1e8}
    time = {"integrator": "energy_momentum", "end": 4e-3, "step": 1e-4}
    heat = [{"table": [[0.0, 0.0], [1e-3, -200.0]]}]
    support = [{"node_set": "all", "fix": "yz"}, {"node_set": "start", "fix": "x"}]
    load = [{"node_set": "end", "force": [1200.0, 0.0, 0.0]}]
    case = rod(
        {"pretension": RAMP}, material, time=time, temperature=heat, support=support, load=load, solver={"rtol": 1e-13}
    )
    history = run(case, tmp_path)
    scale = max(history["elastic_energy"].max(), history["kinetic_energy"].max())
    assert history["kinetic_energy"].max() > 0.05 * scale
    assert (history["plastic_dissipation"][-1] > 0.01 * scale) == plastic
    assert np.abs(history["numerical_dissipation"]).max() < 1e-11 * scale
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * scale


LAWS = {
    "cable": ({"law": "cable"}, {}),
    "strut": ({"law": "strut", "yield_stress": 5e7}, {"shape": "round"}),
    "rupture": ({"rupture": {"stress": 1e9}}, {}),
}


EVERY = {
    "cable": {},
    "compaction": {"compaction_strain": 0.3, "compaction_modulus": 1e9},
    "cowper_symonds": {"yield_stress": 5e7, "rate_reference": 40.0, "rate_exponent": 5.0},
    "damage": {"tensile_strength": 5e7, "fracture_energy": 1e5},
    "elastoplastic": {"yield_stress": 5e7},
    "voce": {"yield_stress": 5e7, "saturation_stress": 1e7, "saturation_rate": 10.0},
}


@pytest.mark.parametrize("law", EVERY)
@pytest.mark.parametrize("keys", [{}, {"stiffness_damping": 1e-6}])
def test_stretch_by_every_law(law, keys):
    """All laws are elastic up to 10 MPa, and their loops can be called without being compiled."""
    material = rod({}, {"law": law, **EVERY[law], **keys}).material["m"]
    chosen = law_of(material)
    data = (1e9,) * len(chosen.bar_data)  # a length, or a modulus, that is out of reach
    stretch = stretch_of(chosen, MEASURES["engineering"], (*material.numbers(), *data), 1e7, as_force=True)
    assert stretch == pytest.approx(1.0 + 1e7 / YOUNG, rel=1e-14)


@pytest.mark.parametrize("law", LAWS)
def test_balance_with_other_laws(law, tmp_path):
    """Laws that read data of each bar, or are slack in compression, are stressed in the same way."""
    material, section = LAWS[law]
    time = {"integrator": "central_differences", "end": 2e-3, "step": 5e-5}
    history = run(rod({"pretension": RAMP, **section}, material, ends=("start",), time=time), tmp_path)
    assert history["kinetic_energy"].max() > 0.05 * history["prestress_work"].max() > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["prestress_work"].max()
    held = run(rod({"pretension": RAMP, **section}, material, time={"end": 1e-3}), tmp_path / "held")
    np.testing.assert_allclose(held["prestress_work"], held["elastic_energy"], rtol=1e-10, atol=1e-12)
    assert open_result(tmp_path / "held").field("axial_force", -1) == pytest.approx([1500.0] * 2, rel=1e-12)
