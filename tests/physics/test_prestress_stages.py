"""Rest lengths prescribed in later stages, and what is refused."""

import numpy as np
import pytest
from helpers.cables import AREA, LENGTH, YOUNG, cell, fan, rod
from helpers.runs import run
from helpers.small_models import check_balances
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case, Simulation, write_mesh
from pfem_petsc.errors import InputError


@pytest.mark.slow
@pytest.mark.parallel
def test_stages_keep_what_is_stressed(shared_tmp_path, comm):
    """Stressed in the first stage, a bar stays so; let go in the second, it moves from there."""
    held = [{"node_set": "all", "fix": "yz"}, {"node_set": "start", "fix": "x"}]
    stages = [
        {"name": "stress", "static": {"step": 0.25}, "support": [*held, {"node_set": "end", "fix": "x"}]},
        {"name": "fly", "support": held, "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 2e-5}},
    ]
    stages[1]["time"]["end"] = 2e-3
    output = {"probe": [{"name": "all", "node_set": "all"}], "fields_every": 4}
    case = rod({"pretension": [[0.0, 0.0], [1.0, 4000.0]]}, stage=stages, output=output)
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 60)
    check_balances(history)
    assert cell(shared_tmp_path / "whole", comm, "axial_force", 1) == pytest.approx([4000.0] * 2, rel=1e-9)
    x = history["probe/all/position"][4:, 2, 0]
    assert x[0] == LENGTH and x.min() < LENGTH / (1.0 + 4000.0 / (YOUNG * AREA))
    energy = history["elastic_energy"] + history["kinetic_energy"]
    np.testing.assert_allclose(energy[4:], energy[4], rtol=1e-3)


YIELDING = {"yield_stress": 1e7, "isotropic_hardening": 1e8}


@pytest.mark.parametrize(
    ("section", "material", "text"),
    [
        ({"pretension": 1001.0}, YIELDING, "pretension = 1001 N: the material yields"),
        ({"prestress": [[0.0, 0.0], [1.0, -1.1e7]]}, YIELDING, "prestress = -1.1e+07 Pa: the material yields"),
        ({"pretension": 1e6}, {"strain": "logarithmic"}, "does not reach it at any length"),
        ({"pretension": -3e5}, {}, "does not reach it at any length"),
        ({"pretension": 1.0, "prestress": 1.0}, {}, "at most one of the keys"),
        ({"rest_length": 0.0}, {}, "expected a factor on the length in the mesh"),
        ({"rest_length": [[0.0, 1.0], [0.0, 0.9]]}, {}, "times must increase"),
        ({"pretension": "1 kN"}, {}, "expected a number in SI units"),
        ({"pretension": [[0.0, 1.0, 2.0]]}, {}, "or rows"),
        ({"pretension": float("nan")}, {}, "expected a finite number"),
    ],
)
def test_refused(section, material, text, tmp_path):
    with pytest.raises(InputError, match="section.s") as error:
        Simulation(rod(section, material), output=tmp_path / "out", quiet=True)
    assert text in str(error.value)


def test_pretension_up_to_yield_is_accepted(tmp_path):
    history = run(rod({"pretension": 999.999}, YIELDING), tmp_path)
    assert history["plastic_dissipation"][-1] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("second", [[[0.0, 3000.0], [1.0, 6000.0]], 6000.0])
@pytest.mark.parametrize("method", ["newton", "relaxation"])
def test_a_later_stage_stresses_further(method, second, shared_tmp_path, comm):
    """Rows over the load factor of the stage, or at once: the end is that of one stage with the last value."""
    newton = {"static": {"step": 0.5, "method": method}}
    whole = run(fan(shared_tmp_path, comm, 6000.0, static={"step": 1.0}), shared_tmp_path / "whole")
    stages = [{"name": "a", **newton}, {"name": "b", "section": {"default": {"pretension": second}}, **newton}]
    stages.append({"name": "c", **newton})  # they stay as they are
    case = fan(shared_tmp_path, comm, [[0.0, 0.0], [1.0, 3000.0]], stage=stages)
    assert Case.from_dict(case.to_dict(), folder=shared_tmp_path) == case
    history = run(case, shared_tmp_path / "staged")
    at = [np.flatnonzero(history["stage"] == k)[-1] for k in range(3)]
    found = history["probe/knot/position"][at, 0]
    assert np.linalg.norm(found[0] - found[1]) > 1e-4
    np.testing.assert_allclose(found[1], whole["probe/knot/position"][-1, 0], atol=1e-9)
    np.testing.assert_allclose(found[2], found[1], atol=1e-12)
    assert history["elastic_energy"][at[1]] == pytest.approx(whole["elastic_energy"][-1], rel=1e-8)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["elastic_energy"].max()


@pytest.mark.parametrize("integrator", ["central_differences", "energy_momentum", "hulbert_chung"])
def test_stressing_in_a_later_stage_in_motion(integrator, comm, tmp_path):
    """Of one section; the other keeps what it has. Works balance, and a restart within is bitwise."""
    step = 2e-5
    time = {"time": {"integrator": integrator, "step": step, "end": 20 * step}}
    groups = {"first": [0], "second": [1]}
    if comm.rank == 0:
        write_mesh(tmp_path / "rod.h5", [[0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], [[0, 1], [1, 2]], bar_groups=groups)
    section = {name: {"area": AREA, "material": "m", "bars": name, "pretension": 900.0} for name in groups}
    stage = [
        {"name": "a", **time},
        {"name": "b", "section": {"second": {"pretension": [[0.0, 900.0], [10 * step, 4000.0]]}}, **time},
    ]
    sets = {"start": {"indices": [0]}, "end": {"indices": [2]}, "all": {"all": True}}
    output = {"probe": [{"name": "all", "node_set": "all"}]}
    mesh = {"file": str(tmp_path / "rod.h5")}
    tables = {"section": section, "output": output, "solver": {"rtol": 1e-12}}
    data = rod({}, mesh=mesh, node_set=sets, static={"step": 1.0}).to_dict()
    del data["static"]
    case = Case.from_dict(data | tables | {"stage": stage})
    whole = assert_restart_is_bitwise(case, comm, tmp_path, 30)
    first, later = whole["stage"] == 0, whole["stage"] == 1
    middle = whole["probe/all/position"][:, 1, 0] - 1.0
    assert np.abs(middle[first]).max() < 1e-15 and middle[later].max() > 1e-4
    assert np.abs(whole["prestress_work"][first]).max() == 0.0 and whole["prestress_work"][-1] > 0.1
    assert np.abs(whole["energy_imbalance"]).max() < 1e-9 * whole["elastic_energy"].max()


@pytest.mark.parametrize(
    "given, told",
    [
        ({"other": {"pretension": 1.0}}, r"stage\[1\].section.other.*no section of this name"),
        ({"s": {"area": 1.0}}, r"stage\[1\].section.s.*one of pretension, prestress, rest_length"),
        ({"s": {"pretension": 1.0, "rest_length": 1.0}}, r"stage\[1\].section.s.*one of pretension"),
        ({"s": {"rest_length": -1.0}}, r"stage\[1\].section.s.rest_length"),
        (3.0, r"stage\[1\].section.*expected tables"),
    ],
)
def test_what_a_stage_cannot_stress(given, told):
    static = {"static": {"step": 1.0}}
    with pytest.raises(InputError, match=told):
        rod({}, stage=[{"name": "a", **static}, {"name": "b", "section": given, **static}])
