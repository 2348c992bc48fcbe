"""Statics of trusses with cables that become slack and struts that buckle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.runs import run_with_fields
from helpers.small_models import case_of
from helpers.twins import Strut, solid

from pfem_petsc import Case, Simulation, write_mesh
from pfem_petsc.errors import InputError

SQUARE = [[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]]
CABLE = {"law": "cable", "young_modulus": 2e11, "density": 7850.0}


@pytest.mark.parallel
@pytest.mark.parametrize("method", [{"step": 0.5}, {"method": "relaxation"}])
def test_slack_members(comm, shared_tmp_path, method):
    """SSNL105 of code_aster: a square of bars with two cables as diagonals, pushed sideways."""
    bars = [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]]
    if comm.rank == 0:
        import h5py

        with h5py.File(shared_tmp_path / "mesh.h5", "w") as file:
            file["points"], file["bars"] = np.array(SQUARE, dtype=float), np.array(bars)
            file["bar_groups/cables"] = np.array([4, 5])
    comm.Barrier()
    case = Case.from_dict(
        {
            "mesh": {"file": "mesh.h5"},
            "node_set": {"feet": {"indices": [0, 3]}, "all": {"all": True}, "pushed": {"indices": [2]}},
            "material": {"cable": CABLE, "bar": {"young_modulus": 2e11, "density": 7850.0}},
            "section": {
                "bars": {"area": 1e-3, "material": "bar"},
                "cables": {"area": 1e-3, "material": "cable", "bars": "cables"},
            },
            "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "all", "fix": "y"}],
            "load": [{"node_set": "pushed", "force": [1000.0, 0.0, 0.0]}],
            "static": method,
        },
        folder=shared_tmp_path,
    )
    history, fields = run_with_fields(case, comm, shared_tmp_path / "out")
    expected = [0.0, 0.0, -1000.0, 0.0, 1000.0 * math.sqrt(2.0), 0.0]
    assert fields["axial_force"] == pytest.approx(expected, rel=1e-4, abs=0.1)
    assert fields["status"].tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 2.0]
    assert history["slack_bars"][-1] == 1


def test_cable_longer_than_its_span_is_slack_until_it_is_pulled(comm, shared_tmp_path):
    """One bar whose end is moved: slack up to its plastic elongation, on the way back as well."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [1]}},
            "material": {"m": {**CABLE, "yield_stress": 2e8, "isotropic_hardening": 1e9}},
            "section": {"s": {"area": 1e-4, "material": "m"}},
            "support": [
                {"node_set": "foot", "fix": "xyz"},
                {
                    "node_set": "tip",
                    "fix": "xyz",
                    "motion": [[0, 0, 0, 0], [1, 3e-3, 0, 0], [2, -1e-3, 0, 0], [3, 3e-3, 0, 0]],
                    "interpolation": "linear",
                },
            ],
            "static": {"step": 0.25, "end": 3.0},
            "output": {"probe": [{"name": "tip", "node_set": "tip"}]},
        }
    )
    history, fields = run_with_fields(case, comm, shared_tmp_path / "out")
    flow = (2e11 * 3e-3 - 2e8) / (2e11 + 1e9)
    way = history["probe/tip/position"][:, 0, 0] - 1.0
    force = history["probe/tip/reaction"][:, 0, 0]
    after = history["load_factor"] > 1.0
    expected = np.where(after, np.maximum(2e7 * (way - flow), 0.0), np.minimum(2e7 * way, np.inf))
    yields = ~after & (way > 1e-3)
    expected[yields] = 1e-4 * (2e8 + 1e9 * (2e11 * way[yields] - 2e8) / (2e11 + 1e9))
    assert force == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert history["slack_bars"].tolist() == (after & (way < flow)).astype(int).tolist()
    assert fields["status"].tolist() == [0.0]


def strut_case(bar, static, force=-1.0, **more):
    material, section = solid(bar)
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": bar.length, "elements": 1},
            "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [1]}},
            "material": {"m": {**material, **more}},
            "section": {"s": {**section, "material": "m"}},
            "support": [{"node_set": "foot", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
            "load": [{"node_set": "tip", "force": [force, 0.0, 0.0], "table": [[0.0, 0.0], [1.0, 1.0]]}],
            "static": static,
            "output": {"fields_every": 0, "probe": [{"name": "tip", "node_set": "tip"}]},
        }
    )


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["displacement", "arc_length"])
@pytest.mark.parametrize("slenderness", [40.0, 200.0])
def test_path_control_follows_the_softening_of_a_strut(comm, shared_tmp_path, method, slenderness):
    """The load over the shortening, beyond Euler's load or the yield force, is the strut's."""
    bar = Strut(200e9, 200e6, slenderness, 1e-3)
    peak = min(bar.euler, bar.yields) * bar.area
    static = {"method": method, "node_set": "tip", "direction": [-1.0, 0.0, 0.0], "displacement": 4e-3 * bar.length}
    static |= {"max_points": 600, "step": 0.05}
    history, _ = run_with_fields(strut_case(bar, static, force=-peak), comm, shared_tmp_path / "out")
    assert history["newton_iterations"].max() <= 12
    strain = history["probe/tip/position"][:, 0, 0] / bar.length - 1.0
    state, expected = bar.start(), [0.0]
    for each in strain[1:].tolist():
        stress, state, _ = bar.step(each, state)
        expected.append(-stress * bar.area / peak)
    assert strain[-1] <= -4e-3 * (1.0 - 1e-9)
    assert history["load_factor"] == pytest.approx(expected, abs=1e-6)
    assert max(expected) > 0.85 and expected[-1] < 0.8 * max(expected)


@pytest.mark.parallel
@pytest.mark.parametrize("law", ["cable", "strut", "damage"])
def test_prestress(law, comm, shared_tmp_path):
    """Bars of two lengths between supports have the force that their section prescribes."""
    keys = {"cable": {}, "strut": {"yield_stress": 2e8}, "damage": {"tensile_strength": 2e8, "fracture_energy": 1e6}}
    force = -900.0 if law == "strut" else 900.0  # Euler's loads are 1571 and 1005 N
    case = case_of(
        shared_tmp_path,
        comm,
        [[0, 0, 0], [1.0, 0, 0], [1.0, 1.25, 0]],
        [[0, 1], [1, 2]],
        fixed=(0, 1, 2),
        material={"m": {"law": law, "young_modulus": 2e11, "density": 7850.0, **keys[law]}},
        section={"s": {"area": 1e-4, "material": "m", "shape": "round", "pretension": force}},
        static={"step": 1.0},
    )
    _, fields = run_with_fields(case, comm, shared_tmp_path / "out")
    assert fields["axial_force"] == pytest.approx([force, force], rel=1e-9)


@pytest.mark.slow
def test_each_strut_buckles_at_the_load_of_its_own_area_and_length(comm, shared_tmp_path):
    fields = {"a": np.array([1e-4, 3e-4])}
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.5, 0.0, 0.0]]
    write_mesh(shared_tmp_path / "graded.h5", points, [[0, 1], [1, 2]], bar_fields=fields, comm=comm)
    motion = {"fix": "xyz", "interpolation": "linear"}
    case = Case.from_dict(
        {
            "mesh": {"file": "graded.h5"},
            "node_set": {name: {"indices": [k]} for k, name in enumerate(("first", "middle", "last"))},
            "material": {"m": {"law": "strut", "young_modulus": 2e11, "density": 7850.0, "yield_stress": 8e8}},
            "section": {"s": {"area_field": "a", "material": "m", "shape": "round"}},
            "support": [
                {"node_set": "first", "motion": [[0, 0, 0, 0], [1, 2e-4, 0, 0]], **motion},
                {"node_set": "middle", "fix": "xyz"},
                {"node_set": "last", "motion": [[0, 0, 0, 0], [1, -3e-4, 0, 0]], **motion},
            ],
            "static": {"step": 0.5},
        },
        folder=shared_tmp_path,
    )
    _, fields = run_with_fields(case, comm, shared_tmp_path / "out")
    euler = 0.25 * math.pi * 2e11 * np.array([1e-4, 3e-4]) ** 2 / np.array([1.0, 1.5]) ** 2
    assert fields["axial_force"] == pytest.approx(-euler, rel=1e-9)


@pytest.mark.parallel
@pytest.mark.parametrize("linear", ["cg", "gamg"])
def test_iterative_solvers_take_slack_cables_whose_nodes_are_held(linear, comm, shared_tmp_path):
    """A square of bars on two feet with two diagonals, one of which is slack."""
    diagonals = {"law": "cable", "young_modulus": 2e11, "density": 7850.0}
    case = case_of(
        shared_tmp_path,
        comm,
        SQUARE,
        [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]],
        node_set={"feet": {"indices": [0, 3]}, "all": {"all": True}, "pushed": {"indices": [2]}},
        material={"m": diagonals},
        section={"s": {"area": 1e-3, "material": "m", "pretension": 500.0}},
        support=[{"node_set": "feet", "fix": "xyz"}, {"node_set": "all", "fix": "y"}],
        load=[{"node_set": "pushed", "force": [1000.0, 0.0, 4000.0]}],
        static={"step": 0.5},
        solver={"linear": linear},
    )
    history, fields = run_with_fields(case, comm, shared_tmp_path / "out")
    assert (fields["status"] == 2.0).sum() == history["slack_bars"][-1]
    force = fields["axial_force"]
    assert force.min() >= 0.0
    assert force[1] + force[4] / math.sqrt(2.0) == pytest.approx(1000.0, rel=1e-3)


def test_unsuitable_bars_are_refused(comm, shared_tmp_path):
    case = strut_case(Strut(200e9, 200e6, 200.0), {"step": 0.5})
    data = case.to_dict()
    del data["section"]["s"]["shape"]
    with pytest.raises(InputError, match=r"section\.s with material\.m: bar 0: a strut buckles: give the section"):
        Simulation(Case.from_dict(data), comm, output=shared_tmp_path / "out", quiet=True).start()
    wrong = {**data, "section": {"s": {"area": 1e-4, "material": "m", "shape": "tube"}}}
    with pytest.raises(InputError, match="needs two of area, diameter, thickness, got area"):
        Case.from_dict(wrong)
    wrong["section"]["s"] |= {"thickness": 6e-3}
    with pytest.raises(InputError, match=r"too much for a tube"):
        Case.from_dict(wrong)
