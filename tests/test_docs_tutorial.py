"""Every file and command of docs/tutorial.md, in its order and in one folder, does what the page says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.launch import environment

from pfem_petsc import open_result
from pfem_petsc.cli.main import main

PAGE = Path(__file__).parents[1] / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(toml|python|bash)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
STAND_INS = {
    "python": f'exec "{sys.executable}" "$@"',
    "module": "exit 0",
    "srun": 'exec mpirun -n 2 "$@"',
    "sbatch": 'echo "submitted $1"',
}
"""Commands of a cluster that this machine may not have."""


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> dict[str, str]:
    """What each block printed, by its text, and the folder under ``""``."""
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "bin").mkdir()
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "activate").touch()
    for name, text in STAND_INS.items():
        (folder / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / "bin" / name).chmod(0o755)
    settings = {**environment(), "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    printed = {"": str(folder)}
    for language, text in BLOCK.findall(PAGE.read_text()):
        if language in ("toml", "python"):
            (folder / re.match(r"# (\S+)\n", text)[1]).write_text(text)
            continue
        script = folder / ("job.sh" if text.startswith("#!") else "commands.sh")
        script.write_text(text)
        command = ["bash", "-e", script.name]
        done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{text}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
        assert "Traceback" not in done.stderr and "warning" not in done.stderr, done.stderr
        printed[text] = done.stdout
    return printed


def output(told: dict[str, str], command: str) -> str:
    return next(printed for text, printed in told.items() if command in text)


@pytest.mark.slow
def test_numbers_of_the_page(told):
    text = PAGE.read_text()
    quoted = re.search(r"It prints `(force: .*?)`", text)[1]
    assert quoted == output(told, "python force.py").strip()
    info = output(told, "info results/rod_impact")
    start, end = re.search(r"kinetic_energy +([\d.]+) mJ +([\d.]+) mJ", info).groups()
    elastic = re.search(r"elastic_energy .* ([\d.]+) mJ$", info, flags=re.MULTILINE)[1]
    assert float(start) == 125.0
    assert (float(end) + float(elastic)) / float(start) == pytest.approx(0.975, abs=1e-3)
    assert energy_left(Path(told[""]) / "results" / "newmark") == pytest.approx(1.0 - 0.19, abs=5e-3)
    sway, rest = output(told, "python tower.py").splitlines()[:2]
    largest, last = map(float, re.findall(r"([\d.]+) mm", sway))
    equilibrium = float(re.search(r"([\d.]+) mm", rest)[1])
    assert 1.6 < largest / equilibrium < 2.0 and last == pytest.approx(equilibrium, rel=5e-3)


def energy_left(folder: Path) -> float:
    history = open_result(folder).history
    energy = history["kinetic_energy"] + history["elastic_energy"]
    return float(energy[-1] / energy[0])


@pytest.mark.slow
def test_mistakes_that_check_finds(told, capsys, monkeypatch):
    monkeypatch.chdir(told[""])
    assert main(["check", "rod.toml", "--set", "section.rod.area=100.0"]) == 0
    assert "no bar has that; 1 mm2 is 1e-6 m2" in "".join(capsys.readouterr())
    assert main(["check", "rod.toml", "--set", "wall.0.normal=[1.0, 0.0, 0.0]"]) == 2
    assert "beyond the wall" in capsys.readouterr().err


@pytest.mark.slow
def test_lattice_and_job(told):
    assert re.search(r"bars +7,440\n", output(told, "mpirun -n 2 python -m pfem_petsc drop.toml\n"))
    again = output(told, "--restart --set time.end=1e-4")
    assert "changed: time.end: 6e-05 -> 0.0001" in again and re.search(r"done: 4\d steps in .* t = 100\.\d µs", again)
    bars = re.search(r"bars +([\d,]+)", output(told, "mesh.cells=[12,12,16]"))[1]
    assert f"{bars} bars" in PAGE.read_text()
    job = output(told, "#SBATCH")
    assert "done:" in job and "submitted" not in job


@pytest.mark.slow
def test_files_of_the_page_are_written(told):
    results = Path(told[""]) / "results"
    for name in ("energies.png", "momentum.png", "walls.png", "render.mp4", "render.png"):
        assert (results / "rod_impact" / name).stat().st_size > 1000, name
    assert (results / "rod-sweep" / "sweep.csv").read_text().count("\n") == 3
    newmark = (results / "newmark" / "curves.png").stat().st_size
    assert newmark > 1000
