"""The material law of the folder examples."""

from __future__ import annotations

import dataclasses
import importlib
import re

import numpy as np
import pytest
from document_laws import text_of, undocumented
from helpers.pages import run
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case, open_result
from pfem_petsc.case import base
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError

LAW = {"young_modulus": 1e6, "density": 1000.0, "yield_stress": 2e3, "hardening": 1e5, "viscosity": 500.0}
LAW |= {"law": "viscoplastic", "rate_viscosity": 20.0}
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}  # the trapezoidal rule
VARIABLES = ("plastic_strain", "back_stress", "dissipated_density")


def one_bar(integrator, h, steps, **more):
    """A bar of 1 m along x, 1 cm2: its foot is held, its tip has 0.05 kg and is thrown."""
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"foot": {"nearest": [0.0, 0.0, 0.0]}, "tip": {"nearest": [1.0, 0.0, 0.0]}},
            "material": {"it": LAW},
            "section": {"it": {"area": 1e-4, "material": "it"}},
            "initial": {"on": [{"node_set": "tip", "velocity": [0.5, 0.0, 0.0]}]},
            "support": [{"node_set": "foot", "fix": "xyz"}],
            "time": {"integrator": integrator, "step": h, "end": h * steps, **PARAMETERS.get(integrator, {})},
            "solver": {"rtol": 1e-13, **more},
            "output": {
                "fields_every": 1,
                "fields": ["stress", *VARIABLES],
                "probe": [{"name": "tip", "node_set": "tip"}],
            },
        }
    )


def viscoplastic(strain, before, h, q):
    """Stress and internal variables after a step, by the equations of the law alone."""
    plastic, back, heat = q
    over = 1e6 * (strain - plastic) - back
    rate = (strain - before) / h
    if abs(over) > 2e3:
        # eta de_p/h = |E (e - e_p) - b| - s_Y with e_p and b at the end
        flow = np.sign(over) * (abs(over) - 2e3) / (1e6 + 1e5 + 500.0 / h)
        plastic, back = plastic + flow, back + 1e5 * flow
        heat += (1e6 * (strain - plastic) - back) * flow
    return 1e6 * (strain - plastic) + 20.0 * rate, (plastic, back, heat + 20.0 * rate * rate * h)


def thrown(integrator, h, steps):
    """Displacements of the tip, stresses and internal variables of the bar, step by step."""
    area_over_mass = 1e-4 / 0.05
    x, v, a, half, stress, q = 0.0, 0.5, 0.0, 0.5, 0.0, (0.0, 0.0, 0.0)
    rows = [(x, stress, *q)]
    for _ in range(steps):
        end = x + h * half
        if integrator == "central_differences":
            half -= h * area_over_mass * viscoplastic(end, x, h, q)[0]
        else:
            for _ in range(40):  # a contraction by (w h)^2/4
                force = viscoplastic(end, x, h, q)[0]
                if integrator == "newmark":
                    end = x + h * v + 0.25 * h * h * (a - area_over_mass * force)
                else:
                    end = x + h * v - 0.5 * h * h * area_over_mass * 0.5 * (stress + force)
            v = 2.0 * (end - x) / h - v
        stress, q = viscoplastic(end, x, h, q)
        x, a, half = end, -area_over_mass * stress, half if integrator == "central_differences" else v
        rows.append((x, stress, *q))
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "energy_momentum"])
def test_law_is_integrated_as_by_itself(integrator, operator, examples, comm, shared_tmp_path):
    """The response of one bar, in each kind of step, against its equations written once more."""
    if operator == "matrix_free" and integrator != "newmark":
        pytest.skip("a Hessian without a matrix is that of symmetric implicit schemes")
    more = {"operator": operator, "linear": "cg"} if operator == "matrix_free" else {}
    run(one_bar(integrator, 2e-3, 120, **more), comm, shared_tmp_path / "bar")
    result = open_result(shared_tmp_path / "bar")
    expected = thrown(integrator, 2e-3, 120)
    moved = np.asarray(result.history["probe/tip/position"])[:, 0, 0] - 1.0
    assert np.abs(moved - expected[:, 0]).max() < 1e-10 * np.abs(expected[:, 0]).max()
    for column, name in enumerate(("stress", *VARIABLES), start=1):
        found = np.array([result.field(name, k)[0] for k in range(len(result.times))])
        assert np.abs(found - expected[:, column]).max() < 1e-10 * np.abs(expected[:, column]).max(), name
    assert np.abs(expected[:, 2]).max() > 1e-3 and (np.diff(expected[:, 4]) >= 0.0).all()
    energy = np.asarray(result.history["kinetic_energy"])
    assert np.abs(result.history["energy_imbalance"]).max() < 1e-10 * energy[0]
    heat = np.asarray(result.history["plastic_heat"])
    assert heat == pytest.approx(1e-4 * expected[:, 4], rel=1e-9, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "chung_lee", "energy_momentum"])
def test_law_restarts_to_the_last_bit(integrator, examples, comm, shared_tmp_path):
    """A chain that yields, stopped on the way: positions, and internal variables in snapshots and checkpoints."""
    case = Case.from_dict(one_bar(integrator, 2e-4, 60).to_dict(), overrides=["mesh.elements=6"])
    assert_restart_is_bitwise(case, comm, shared_tmp_path, 40)
    for name in VARIABLES:
        assert np.abs(open_result(shared_tmp_path / "whole").field(name, -1)).max() > 0.0, name


SCHEMES = ("chung_lee", "hulbert_chung", "souza_moura", "central_differences")
SCHEMES += ("newmark", "houbolt", "wilson", "generalized_alpha", "energy_momentum")


def test_law_without_mean_stress_is_refused_by_the_energy_momentum_scheme(examples, monkeypatch, tmp_path, capsys):
    module = importlib.import_module("pfem_petsc.mechanics.materials.viscoplastic")
    monkeypatch.setattr(module, "LAW", dataclasses.replace(module.LAW, mean_stress=None))
    path = tmp_path / "bar.toml"
    path.write_text(one_bar("energy_momentum", 2e-3, 10).to_toml())
    assert main(["run", str(path), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert 'material.it.law = "viscoplastic" is not compatible with time.integrator = "energy_momentum"' in said
    assert "mean_stress" in said and "use another integrator or law" in said


def test_keys_of_a_law_are_documented_by_their_texts(examples, monkeypatch):
    """Nothing but the law's file: its part of the documentation is made from its Parameters."""
    text = text_of("viscoplastic")
    assert text.startswith("#### `viscoplastic`\n\nViscoplastic bar with kinematic hardening")
    for key, unit in (("hardening", "[Pa]"), ("viscosity", "[Pa s]"), ("rate_viscosity", "[Pa s]")):
        assert re.search(rf"^\| `{key}` \| \S+ \| .*{re.escape(unit)}\.? \|$", text, flags=re.MULTILINE), key
    assert "`dissipated_density` [J/m³]" in text
    assert undocumented("viscoplastic") == []
    texts = base._texts
    monkeypatch.setattr(base, "_texts", lambda model: {**texts(model), "viscosity": ""})
    assert undocumented("viscoplastic") == ["viscosity"]


def test_law_without_a_static_limit_or_softening_is_refused(examples, tmp_path, capsys):
    table = one_bar("newmark", 2e-3, 10).to_dict()
    with pytest.raises(InputError, match=r"material.it.softening.*viscoplastic does not soften by a table"):
        Case.from_dict(table | {"material": {"it": LAW | {"softening": [[0.0, 1.0, 1.0]]}}})
    static = {key: value for key, value in table.items() if key not in ("time", "initial")}
    path = tmp_path / "bar.toml"
    path.write_text(Case.from_dict(static | {"static": {"method": "newton"}}).to_toml())
    assert main(["run", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "depends on the rate of strain, and a static analysis has no time" in capsys.readouterr().err
