"""Hostile input: each is refused with one message and status 2, without a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pfem_petsc import Case
from pfem_petsc.cli.main import PREFIXES, exit_message, main, without_effect
from pfem_petsc.errors import InputError, printable
from pfem_petsc.restart import prepare_folder

ROD = Path("pfem_petsc/cases/rod_impact.toml").resolve()


def refused(capsys, *words):
    status = main(list(words))
    said = capsys.readouterr().err
    assert status == 2, said
    assert "internal error" not in said
    assert "Traceback" not in said
    return said


def text_of(**changes):
    return ROD.read_text() + "".join(f"\n{line}" for line in changes.values())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x = " + "7" * 5000, "an integer of more than 4,300 digits"),
        ("[" + ".".join("a" * 20000) + "]", "line 1: .* a key of more than 100 parts"),
        ("a\n" + ".".join("b" * 100000) + " = 1", "line 2: .* a key of more than 100 parts"),
        ("a = " + "[" * 20000 + "]" * 20000, "nested too deep"),
        ("a = " + "{a=" * 3000 + "1" + "}" * 3000, "nested too deep"),
        ("time = " + "0x" + "f" * 5000, "expected a table"),
    ],
    ids=["digits", "tables", "dotted", "lists", "inline", "hex"],
)
def test_texts_that_are_no_cases(text, expected):
    with pytest.raises(InputError, match=f"(?s){expected}"):
        Case.from_toml(text)


@pytest.mark.parametrize("value", ["wall.0.name=.", "output.probe.0.name=..", "wall.0.axis=1"])
def test_names_that_would_be_lost_in_the_results(capsys, value):
    assert value.rpartition(".")[0].split("=")[0].split(".")[0] in refused(capsys, "check", str(ROD), "--set", value)


@pytest.mark.parametrize("change", ["time.step=1e300", "time.step=1e-60", "time.end=1e200"])
@pytest.mark.parametrize("integrator", ["newmark", "central_differences"])
def test_times_whose_powers_overflow(capsys, change, integrator):
    said = refused(capsys, "check", str(ROD), "--set", f"time.integrator={integrator}", "--set", change)
    assert change.partition("=")[0] in said
    assert "overflows" in said


def test_a_step_beyond_the_end_is_told(capsys):
    changes = ["time.integrator=newmark", "time.step=0.2", "time.end=0.1"]
    main(["check", str(ROD), *(word for change in changes for word in ("--set", change))])
    assert "time.step = 0.2 s is longer than time.end = 0.1 s" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["snes_type", "ksp_type", "pc_type", "snes_linesearch_type"])
def test_solver_types_that_petsc_does_not_have(kind, tmp_path):
    """In a process of its own: PETSc keeps options."""
    line = [sys.executable, "-m", "pfem_petsc", "rod_impact", "-o", str(tmp_path / "out"), "--quiet"]
    line += ["--set", "time.integrator=newmark", "--set", "time.step=0.01", "--", f"-pfem_{kind}", "nope"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert "nope" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("axis", [[0.0, 1e160, 1e160], [1e-200, 0.0, 0.0]])
def test_directions_whose_length_overflows(axis):
    wall = {"name": "w", "type": "cylinder", "point": [0.0, 0.0, 9.0], "axis": axis, "radius": 1.0}
    data = Case.load("rod_impact").to_dict()
    with pytest.raises(InputError, match="axis.*out of range"):
        Case.from_dict({**data, "wall": [wall]})


@pytest.mark.parametrize(
    "words",
    [
        ("rod\udcff.toml",),
        ("check", "rod_impact", "--set", "title=\udcff"),
        ("rod_impact", "--", "-pfem_\udcff"),
    ],
)
def test_bytes_that_are_no_text(capsys, words):
    assert "not UTF-8" in refused(capsys, *words)


@pytest.mark.parametrize("key", ["wall." + "9" * 5000 + ".friction", ".".join("a" * 100000), "wall.².friction"])
def test_keys_on_the_command_line(capsys, key):
    assert "--set" in refused(capsys, "check", "rod_impact", "--set", f"{key}=1")


def test_an_options_file_that_is_not_there(capsys):
    assert "-options_file gone: there is no such file" in refused(capsys, "rod_impact", "--", "-options_file", "gone")
    assert "-options_file : there is no such file" in refused(capsys, "rod_impact", "--", "-options_file")


def test_solver_options_without_effect_are_told():
    assert without_effect(["-pfem_snes_monitor", "-pfem_assembled_pc_gamg_threshold", "0.02", "-log_view"]) == []
    table = (Path(__file__).parents[2] / "docs" / "linear_solvers.md").read_text()
    examples = [row.split("`")[3] for row in table.splitlines() if row.startswith("| `pfem_")]
    assert len(examples) == len(PREFIXES)
    assert [line for example in examples for line in without_effect(example.split())] == []
    (line,) = without_effect(["-ksp_rtol", "1e-3"])
    assert "did you mean -pfem_ksp_rtol?" in line
    (line,) = without_effect(["-pfem_contct_snes_type", "nope"])
    assert "did you mean -pfem_contact_snes_type?" in line


def test_control_characters_do_not_reach_the_terminal():
    assert printable("a\x1b[31m\nb\x9b") == "a\\x1b[31m\nb\\x9b"


def test_a_full_disk_under_the_output_is_told():
    status, text = exit_message(OSError(28, os.strerror(28)))
    assert status == 3
    assert "No space left on device" in text


def test_the_current_folder_is_not_moved_aside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "result.vtkhdf").write_text("x")
    for folder in (Path("."), tmp_path):
        with pytest.raises(InputError, match="cannot be moved aside because the current folder is inside.*-o"):
            prepare_folder(folder, None, None)


def test_numpy_values_in_a_case():
    data = Case.load("rod_impact").to_dict()
    data["initial"]["velocity"] = np.array([0.5, 0.0, 0.0])
    data["mesh"]["elements"] = np.int64(7)
    data["time"]["end"] = np.float32(2.0)
    case = Case.from_dict(data)
    assert case.mesh.parameters.elements == 7
    assert case.initial[0].velocity == (0.5, 0.0, 0.0)
    assert case.time.end == 2.0


def test_an_unknown_option_names_the_help_of_its_verb(capsys):
    assert "unrecognized arguments: --blur; see python -m pfem_petsc render --help" in refused(
        capsys, "render", "results", "--blur"
    )


def test_a_group_used_as_a_node_set_is_told_how():
    data = Case.load("rod_impact").to_dict()
    data["support"] = [{"node_set": "start", "fix": "x"}]
    with pytest.raises(InputError, match=r'node_set.NAME = \{ group = "start" \}'):
        Case.from_dict(data)
