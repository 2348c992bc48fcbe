"""The examples of the README work as shown, and docs/command_line.md shows what there is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pfem_petsc.case.schema import Case
from pfem_petsc.cli.main import main
from pfem_petsc.registry import choices

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
COMMAND_LINE = (ROOT / "docs" / "command_line.md").read_text()
CHOICES = (ROOT / "docs" / "choosing.md").read_text()


def blocks(language: str, page: str = README) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    return [text for name, text in fenced if name == language]


def test_case_file_is_the_built_in_one(tmp_path):
    (text,) = blocks("toml")
    (tmp_path / "shown.toml").write_text(text)
    shown, built_in = Case.load(str(tmp_path / "shown.toml")), Case.load("rod_impact")
    assert shown.to_toml() == built_in.to_toml()


@pytest.mark.slow
def test_python_example_runs(tmp_path):
    code = blocks("python")[0]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code + "\nprint('shape', force.shape, grid.n_cells)"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    assert "shape (301, 3) 20" in done.stdout
    time, energy = done.stdout.strip().splitlines()[-2].split()
    assert float(time) == pytest.approx(3.0) and 0.1 < float(energy) < 0.125


@pytest.mark.parametrize(
    ("row", "package"),
    [
        ("explicit integrators", "integrators"),
        ("implicit integrators", "integrators"),
        ("walls", "contact.walls"),
        ("mesh generators", "mesh.generators"),
    ],
)
def test_what_there_is_to_choose_from_exists(row, package):
    named = re.findall(r"`(\w+)`", re.search(rf"^\| {row} \|.*$", CHOICES, flags=re.MULTILINE)[0])
    assert named and set(named) <= set(choices(f"pfem_petsc.{package}"))


def test_verbs_and_options_exist(capsys):
    synopsis = next(block for block in blocks("", COMMAND_LINE) if "info RESULT" in block)
    for line in synopsis.splitlines():
        verb = re.search(r"pfem_petsc (\S+)", line)[1]
        assert main(["run" if verb == "CASE" else verb, "--help"]) == 0
        shown = capsys.readouterr().out
        for option in re.findall(r"\[(--?[\w-]+)", line):
            assert option in shown or option == "--", (verb, option)


def test_files_named_exist():
    for path in re.findall(r"`(?:bash )?((?:scripts|pfem_petsc|tests)/[\w/.]+)", README + COMMAND_LINE):
        assert (ROOT / path).exists(), path


def test_readme_is_short():
    assert README.count("\n") < 130


@pytest.mark.slow
def test_first_commands_run(tmp_path):
    """Those after the set-up and the activation, without the large one."""
    commands = next(block for block in blocks("") if "activate" in block).splitlines()
    asked = [line.partition("#")[0].split() for line in commands[2:] if "mpirun" not in line]
    assert len(asked) == 4
    for words in asked:
        command = [sys.executable, *words[1:], *(["--frames", "3"] if "render" in words else [])]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "results" / "rod_impact" / "render.mp4").exists()
