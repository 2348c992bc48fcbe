"""The commands of pages about pictures and integrators run in their order, on short results of the cases they name."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from mpi4py import MPI
from PIL import Image

from pfem_petsc import Case, Simulation
from pfem_petsc.cli.main import main

DOCS = Path(__file__).parents[1] / "docs"
RESULTS = {
    "ring_impact": ("ring_impact", ["time.end=0.04", "output.fields_every=200"]),
    "lattice_drop": ("lattice_drop", ["mesh.cells=[3,3,3]", "time.end=1e-4"]),
    "rod_impact": ("rod_impact", []),
    "rod_newmark": ("rod_impact", ["time.integrator=newmark"]),
    "pendulum": ("pendulum", []),
}
"""Built-in case and changes of it, by the name of the folder."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    for name, (case, changes) in RESULTS.items():
        output = folder / "results" / name
        with Simulation(Case.load(case, changes), MPI.COMM_SELF, output=output, quiet=True) as simulation:
            simulation.run()
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "number", "made"),
    [
        (
            "rendering.md",
            3,
            {"ring_impact": ["render.mp4", "render.png", "frames/frame_0000.png"], "lattice_drop": ["render.html"]},
        ),
        (
            "plotting.md",
            6,
            {
                "rod_impact": [
                    "energies.png",
                    "walls.png",
                    "report.html",
                    "curves.png",
                    "curves_2.png",
                    "comparison.png",
                ],
                "pendulum": ["spectra.png"],
            },
        ),
        ("integrators.md", 2, {"rod_impact": ["result.vtkhdf"], "ring_impact": ["result.vtkhdf"]}),
    ],
)
def test_commands_run(folder, monkeypatch, capfd, page, number, made):
    monkeypatch.chdir(folder)
    blocks = re.findall(r"^```(?:bash|sh)?\n(.*?)^```$", (DOCS / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    lines = [line for line in "".join(blocks).splitlines() if line.startswith("python -m pfem_petsc ")]
    assert len(lines) == number
    for line in lines:
        words = shlex.split(line)[3:]
        if words[0] in RESULTS:
            words += ["--set", "output.fields_every=0", "time.end=0.04", "--quiet"]
        if "--html" in words:
            pytest.importorskip("plotly")
        if words[0] == "render" and "--html" not in words:
            words += ["--frames", "3", "--size", "480x270"]
        assert main(words) == 0, (line, capfd.readouterr().err)
    for name, files in made.items():
        for file in files:
            path = folder / "results" / name / file
            assert path.stat().st_size > 2000, path
            if path.suffix == ".png":
                assert min(Image.open(path).size) > 200
