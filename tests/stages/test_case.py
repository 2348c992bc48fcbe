"""Tables of stages: which are in force, what is refused and how it is told, and the way to text and back."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
from helpers.small_models import BLOCK
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.restart import changed_keys


def test_tables_stay_in_force_until_a_stage_replaces_them():
    case = Case.from_dict(BLOCK)
    walls = [[wall.name for wall in stage.wall] for stage in case.stages]
    assert walls == [["floor", "plate"], ["floor", "plate"], ["floor"], ["floor"]]
    assert [len(stage.support) for stage in case.stages] == [2, 2, 0, 1]
    assert [len(stage.initial) for stage in case.stages] == [0, 0, 1, 0]
    assert [len(stage.temperature) for stage in case.stages] == [0, 1, 1, 1]
    assert [stage.output.history_every for stage in case.stages] == [1, 1, 3, 3]
    assert all(stage.output.probe == case.output.probe for stage in case.stages)
    assert case.time is None and case.static is None
    assert [wall.name for wall in case.every_wall] == ["floor", "plate"]


def test_a_case_without_stages_is_its_own_only_stage():
    data = {key: value for key, value in BLOCK.items() if key != "stage"}
    case = Case.from_dict({**data, "static": {"step": 0.5}})
    assert case.stages == (case,)
    assert "stage" not in case.to_dict()


def test_text_of_a_case_reads_back_equal():
    case = Case.from_dict(BLOCK, name="block")
    again = Case.from_toml(case.to_toml())
    assert again == case
    assert again.stages[2].support == []


def test_a_support_that_a_stage_removes_need_not_be_known_to_later_ones():
    data = {key: value for key, value in BLOCK.items() if key not in ("stage", "support")}
    first = {
        "static": {"step": 1.0},
        "support": [{"name": "held", "node_set": "side", "fix": "z"}],
        "remove": [{"supports": "held", "time": 0.5}],
    }
    motion = {"integrator": "newmark", "step": 1e-6, "end": 1e-5}
    later = {"time": motion, "support": [{"node_set": "side", "fix": "xy"}]}
    case = Case.from_dict({**data, "stage": [first, later]})
    assert [len(stage.remove) for stage in case.stages] == [1, 0]
    assert Case.from_toml(case.to_toml()) == case


def test_modes_belong_to_the_last_stage():
    case = Case.from_dict({**BLOCK, "modes": {"count": 3}})
    assert [stage.modes is not None for stage in case.stages] == [False, False, False, True]
    assert Case.from_toml(case.to_toml()) == case


def test_values_are_set_in_stages():
    case = Case.from_dict(BLOCK, overrides=["stage.1.time.step=1e-6", "stage.0.load.0.node_set=side"] + FORCE)
    assert case.stages[1].time.step == 1e-6
    assert case.stages[3].load[0].force == (0.0, 0.0, 1.0)


FORCE = ["stage.0.load.0.force=[0.0, 0.0, 1.0]"]

REFUSED = {
    "nothing to compute": ({1: {"time": None}}, r"stage\[1\]: expected one of the tables .*; it has none"),
    "both": ({1: {"static": {}}}, r"stage\[1\]: expected one of the tables .*; not both"),
    "unknown table": ({0: {"wal": []}}, r"stage\[0\]\.wal: unknown key of a stage.*'wall'"),
    "a table of the mesh": ({0: {"material": {}}}, r"stage\[0\]\.material: unknown key of a stage"),
    "value": ({0: {"static": {"step": -1.0}}}, r"stage\[0\]\.static\.step = -1\.0: expected a value > 0"),
    "key of a table": (
        {2: {"wall": [{"type": "plane", "normal": [0, 0, 1]}]}},
        r"stage\[2\]\.wall\[0\]\.point: this key is missing",
    ),
    "node set": ({1: {"load": [{"node_set": "x", "force": [0, 0, 1]}]}}, r"stage\[1\]\.load\[0\]\.node_set = \"x\""),
    "output": ({1: {"output": {"precision": "float32"}}}, r"stage\[1\]\.output\.precision: unknown key"),
    "name": ({1: {"name": "press"}}, r"stage\[1\]\.name = \"press\": another stage has this name"),
    "empty name": ({1: {"name": ""}}, r"stage\[1\]\.name = \"\""),
    "no table": ({1: 3}, r"stage\[1\] = 3: expected a table"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_told_where_it_is(name):
    changes, message = REFUSED[name]
    data = copy.deepcopy(BLOCK)
    for number, change in changes.items():
        if not isinstance(change, dict):
            data["stage"][number] = change
            continue
        data["stage"][number] |= change
        data["stage"][number] = {key: value for key, value in data["stage"][number].items() if value is not None}
    with pytest.raises(InputError, match=message) as found:
        Case.from_dict(data)
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize("stages", [[], {}, "press", 3])
def test_stages_are_a_list_of_at_least_one(stages):
    with pytest.raises(InputError, match=r"stage = .*expected a list of at least one table"):
        Case.from_dict({**BLOCK, "stage": stages})


@pytest.mark.parametrize("table", ["time", "static"])
def test_an_analysis_beside_stages_is_refused(table):
    given = {"time": {"integrator": "newmark", "step": 1e-6, "end": 1e-5}, "static": {"step": 0.5}}
    having = [f"stage[{k}].{table}" for k, stage in enumerate(BLOCK["stage"]) if table in stage]
    text = f"case: [{table}] and [[stage]] exclude each other: give [stage.{table}]; this case has {', '.join(having)}"
    with pytest.raises(InputError) as found:
        Case.from_dict({**BLOCK, table: given[table]})
    assert str(found.value) == text
    with pytest.raises(InputError) as found:
        Case.from_dict(BLOCK).update({f"{table}.end": 2.0})
    assert str(found.value) == text


def test_a_restart_says_what_it_may_change():
    before = Case.from_dict(BLOCK).to_dict()
    now = copy.deepcopy(before)
    now["stage"][0]["static"]["end"] = 0.5
    with pytest.raises(
        InputError, match=r"may change title, plugins, stage\[3\]\.static\.end, modes, output, solver only"
    ):
        changed_keys(Path("checkpoint.h5"), before, now, "case")
    assert changed_keys(Path("checkpoint.h5"), before, {**before, "title": "other"}, "case")


def test_a_treatment_of_impact_above_a_static_stage_is_told_where_it_belongs():
    case = Case.from_dict({**BLOCK, "contact": {"treatment": "stick"}})
    with pytest.raises(InputError, match=r"stage 'press': .* move it to \[stage.contact\] of the stages with"):
        Simulation(case, MPI.COMM_SELF, check_only=True)
