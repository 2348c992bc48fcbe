"""Load cases and combinations: each the same as a run of its own, from one state; tables of members; restarts."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from helpers.small_models import check_balances
from helpers.stopped import assert_restart_is_bitwise
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.post.members import members

TOP = {"node_set": "top"}
PRESS = [{**TOP, "force": [0.0, 0.0, -40.0]}]
PUSH = [{**TOP, "force": [12.0, 0.0, 0.0]}]
SETTLE = [{"node_set": "bottom", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -2e-3]]}]
WEIGHT = {"acceleration": [0.0, 0.0, -9.81]}
FRAME = {
    "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 2], "pitch": 0.2},
    "node_set": {"bottom": {"box": [[-1, -1, -1e-6], [1, 1, 1e-6]]}, "top": {"box": [[-1, -1, 0.4 - 1e-6], [1, 1, 1]]}},
    "material": {
        "m": {
            "young_modulus": 2e9,
            "density": 1e3,
            "yield_stress": 5.6e6,
            "isotropic_hardening": 1e8,
            "strain": "green",
        }
    },
    "section": {"s": {"material": "m", "shape": "tube", "diameter": 6e-3, "thickness": 1e-3}},
    "support": [{"node_set": "bottom", "fix": "xyz"}],
    "load": [{**TOP, "force": [0.0, 1.0, 0.0]}],
    "static": {"method": "newton", "step": 0.5},
    # MUMPS, which small models take on several ranks, repeats to rounding only
    "solver": {"linear": "cg"},
}
LOAD_CASES = [
    {"name": "dead", "gravity": WEIGHT, "load": PRESS},
    {"name": "push", "load": PUSH},
    {"name": "settlement", "support": SETTLE},
    {"name": "heat", "temperature": [{"value": 50.0}]},
]
COMBINATIONS = [
    {"name": "ULS", "factors": {"dead": 1.35, "push": 1.5}},
    {"name": "SLS", "factors": {"dead": 1.0, "push": -1.0, "settlement": 0.5, "heat": 0.0}},
]
CASES = FRAME | {"load_case": LOAD_CASES, "combination": COMBINATIONS}


def run(data, comm, folder):
    with Simulation(Case.from_dict(data, name="frame"), comm, output=folder, quiet=True) as simulation:
        simulation.run()
    comm.Barrier()
    return open_result(folder)


def times(rows, factor):
    return [{**row, "force": [factor * value for value in row["force"]]} for row in rows]


@pytest.mark.slow
@pytest.mark.parallel
def test_each_is_a_run_of_its_own(comm, shared_tmp_path):
    """Against runs of two stages whose tables are written by hand; yielding makes the order of loads matter."""
    result = run(CASES, comm, shared_tmp_path / "all")
    history, base = result.history, FRAME["load"]
    check_balances({name: history[name] for name in history}, 1e-7)
    assert history["plastic_dissipation"].max() > 0.0
    names = [stage.name for stage in result.case.stages]
    assert names == ["permanent", "dead", "push", "settlement", "heat", "ULS", "SLS"]
    half = [{**SETTLE[0], "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1e-3]]}]
    apart = {
        "dead": {"gravity": WEIGHT, "load": base + PRESS},
        "push": {"load": base + PUSH},
        "settlement": {"support": SETTLE},
        "heat": {"temperature": [{"value": 50.0}]},
        "ULS": {
            "gravity": {"acceleration": [0.0, 0.0, -1.35 * 9.81]},
            "load": base + times(PRESS, 1.35) + times(PUSH, 1.5),
        },
        "SLS": {"gravity": WEIGHT, "load": base + PRESS + times(PUSH, -1.0), "support": half},
    }
    ends = np.asarray(result.stage_ends)[1:]
    common = {key: value for key, value in FRAME.items() if key != "static"}
    stage = {"static": FRAME["static"]}
    for name, tables in apart.items():
        stages = [{"name": "first", **stage}, {"name": "second", **stage, **tables}]
        one = run(common | {"stage": stages}, comm, shared_tmp_path / name)
        snapshot = int(np.flatnonzero(np.isclose(result.times, ends[names.index(name)]))[0])
        for field in ("axial_force", "plastic_strain"):
            scale = np.abs(one.field(field, -1)).max()
            np.testing.assert_allclose(result.field(field, snapshot), one.field(field, -1), atol=1e-7 * scale + 1e-15)
        np.testing.assert_allclose(result.positions(snapshot), one.positions(-1), atol=1e-11)
        row = int(np.flatnonzero(np.isclose(history["time"], ends[names.index(name)]))[0])
        for column in ("elastic_energy", "external_work", "plastic_dissipation", "support_work"):
            if column in history:
                assert history[column][row] == pytest.approx(one.history[column][-1], rel=1e-7, abs=1e-9)


def test_what_varied_before_stays():
    """Loads, gravity, temperatures and supports over the load factor are in load cases as they were at the end."""
    ramp = [[0.0, 0.2], [0.5, 2.0], [1.5, 1.0]]
    moved = {"node_set": "bottom", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [0.8, 1e-3, 0.0, 0.0]]}
    before = {
        "load": [{**TOP, "force": [0.0, 20.0, 0.0], "table": ramp}],
        "gravity": {"acceleration": [[0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, -30.0]]},
        "temperature": [{"table": [[0.0, 60.0], [1.0, 20.0]]}],
        "support": [moved, {"name": "lid", "node_set": "top", "fix": "z"}],
    }
    own = {
        "load": PUSH,
        "gravity": {"acceleration": [0.0, 3.0, 0.0]},
        "temperature": [{"value": 5.0}],
        "support": [
            {"name": "lid", "node_set": "top", "fix": "z", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1e-3]]}
        ],
    }
    case = Case.from_dict(FRAME | before | {"load_case": [{"name": "one", **own}]})
    stage = case.stage[1]
    assert [load.force for load in stage.load] == [(0.0, 30.0, 0.0), (12.0, 0.0, 0.0)]
    assert stage.gravity.acceleration == (0.0, 3.0, -15.0)
    assert [(heat.value, heat.table) for heat in stage.temperature] == [(20.0, None), (5.0, None)]
    assert [support.motion is None for support in stage.support] == [True, False]


def test_gravity_with_rows_keeps_its_interpolation():
    rows = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -9.81]]
    weight = {"name": "dead", "gravity": {"acceleration": rows, "interpolation": "smooth"}}
    case = Case.from_dict(FRAME | {"load_case": [weight], "combination": [{"name": "c", "factors": {"dead": 2.0}}]})
    assert [stage.gravity.interpolation for stage in case.stage[1:]] == ["smooth", "smooth"]
    assert case.stage[2].gravity.acceleration[1] == (1.0, 0.0, 0.0, -19.62)


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_in_any_is_bitwise(comm, shared_tmp_path):
    assert_restart_is_bitwise(Case.from_dict(CASES), comm, shared_tmp_path, 1, 2, 3, 6, 9, 13)


@pytest.mark.slow
def test_members_of_load_cases(tmp_path, capsys):
    result = run(CASES, MPI.COMM_SELF, tmp_path / "out")
    table, each = members(result), members(result, each_case=True)
    assert set(each["case"]) == {"dead", "push", "settlement", "heat", "ULS", "SLS"}
    assert each.n_rows == 6 * table.n_rows == 6 * len(result.bars)
    case, section = result.case, result.case.section["s"]
    ends = result.bars
    points = result.positions(0)
    length = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    area, moment = np.pi * (9.0 - 4.0) * 1e-6, np.pi / 4.0 * (81.0 - 16.0) * 1e-12
    assert section.uniform_area == pytest.approx(area)
    last = int(np.flatnonzero(np.isclose(result.times, np.asarray(result.stage_ends)[names(case).index("ULS") + 1]))[0])
    force = result.field("axial_force", last)
    of = members(result, case="ULS")
    bars = of["bars"].astype(int)
    np.testing.assert_allclose(of["axial_force"], force[bars], rtol=1e-12)
    np.testing.assert_allclose(of["yield_utilisation"], np.abs(force[bars]) / area / 5.6e6, rtol=1e-12)
    buckling = np.maximum(-force[bars], 0.0) * length[bars] ** 2 / (np.pi**2 * 2e9 * moment)
    np.testing.assert_allclose(of["buckling_utilisation"], buckling, rtol=1e-12)
    largest = np.fmax(table["yield_utilisation"], table["buckling_utilisation"])
    assert (np.diff(largest) <= 0.0).all()
    for row in table.rows[:5]:
        same = each.where(each["bars"] == row["bars"])
        assert np.fmax(same["yield_utilisation"], same["buckling_utilisation"]).max() == pytest.approx(
            max(row["yield_utilisation"], row["buckling_utilisation"]), rel=1e-12
        )
        assert row["tension"] == pytest.approx(max(same["tension"]), abs=1e-12)
    folder = str(tmp_path / "out")
    files = {kind: str(tmp_path / f"members.{kind}") for kind in ("csv", "markdown")}
    assert main(["members", folder, "--limit", "3", "--csv", files["csv"], "--markdown", files["markdown"]]) == 0
    told = capsys.readouterr().out
    assert f"{table.n_rows - 3:,} more rows" in told
    with open(files["csv"], newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["axial_force"]) == table["axial_force"][0]
    assert main(["members", folder, "--case", "live"]) == 2
    assert "there is no load case, combination or stage 'live'" in capsys.readouterr().err


def names(case):
    return [stage.name for stage in case.stages]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"load_case": [{"name": "a"}]}, r"load_case\[0\]: has no loads: expected at least one of the tables load"),
        (
            {"combination": [{"name": "c", "factors": {"live": 1.0}}]},
            "factors.live = .live.: there is no load case of this name",
        ),
        (
            {"combination": [{"name": "dead", "factors": {"dead": 1.0}}]},
            "another load case, combination or stage has it",
        ),
        ({"load_case": [*LOAD_CASES, LOAD_CASES[0]]}, r"load_case\[4\].name = .dead.: another load case"),
        (
            {"load_case": [{**LOAD_CASES[0], "name": "permanent"}], "combination": []},
            "the state before the load cases has",
        ),
        ({"combination": [{"name": "c", "factors": {}}]}, "factors = {}: expected at least one entry"),
        ({"static": {"method": "arc_length", "step": 0.1}}, "load cases are solved by the method of the state before"),
        ({"modes": {"count": 2}}, "modes are those of one state"),
        ({"static": None, "time": {"integrator": "newmark", "step": 1e-3, "end": 1.0}}, r"needs \[static\]"),
        (
            {
                "load_case": [{"name": n, "wind": {"velocity": [1.0, 0.0, 0.0]}} for n in ("a", "b")],
                "combination": [{"name": "c", "factors": {"a": 1.0, "b": 1.0}}],
            },
            r"combination\[0\]: 'c' adds the wind of 'a' and 'b', of which one can act",
        ),
    ],
)
def test_refused(change, text):
    with pytest.raises(InputError, match=text):
        Case.from_dict({key: value for key, value in (CASES | change).items() if value is not None})


def test_round_trip_and_editing():
    case = Case.from_dict(CASES)
    assert Case.from_toml(case.to_toml()) == case
    assert "[[stage]]" not in case.to_toml()
    case.load_case[1].load[0].force = [24.0, 0.0, 0.0]
    assert case.stage[names(case).index("ULS")].load[-1].force == (36.0, 0.0, 0.0)
