"""Commands, blocks and files that pages show do what the pages say, and the site is built without warnings."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import theory_figures
from docutils.utils.math import MathError
from helpers.launch import environment
from helpers.pages import DOCS, ROOT, blocks, program_lines, prose
from mpi4py import MPI
from PIL import Image

import pfem_petsc
from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.case.model import ANALYSES, STAGE_TABLES
from pfem_petsc.cli import main as program
from pfem_petsc.cli.main import main
from pfem_petsc.formats import read_whole, suffixes


@pytest.mark.slow
def test_python_of_pages_runs(tmp_path):
    """The blocks of docs/python.md, of which each needs those before, and the one of README; warnings are errors."""
    text = "\n".join(blocks(DOCS / "python.md", "python"))
    text += blocks(ROOT / "README.md", "python")[0] + "\nprint('shape', force.shape, grid.n_cells)\n"
    (tmp_path / "page.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "page.py"],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert "run  time.step  section.legs.area  status" in done.stdout
    assert int(re.search(r"converged reason (\S+),", done.stdout)[1]) > 0
    assert float(re.search(r"difference: (\S+) m", done.stdout)[1]) < 1e-12
    assert (tmp_path / "live.png").stat().st_size > 1000 and (tmp_path / "steps.csv").read_text().count("\n") == 5
    assert '\ncase: time.step = "1 ms": expected a number of seconds in SI units' in done.stdout
    assert "shape (301, 3) 20" in done.stdout
    time, energy = done.stdout.strip().splitlines()[-2].split()
    assert float(time) == pytest.approx(3.0) and 0.1 < float(energy) < 0.125


@pytest.mark.slow
def test_examples_of_modes_and_loads_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with Simulation(Case.load("taut_cable"), MPI.COMM_SELF, quiet=True) as simulation:
        simulation.run()
    for page in ("modes.md", "loads.md"):
        exec(compile(blocks(DOCS / page, "python")[0], page, "exec"), {})
    kind, first = re.match(r"(\w+) \[\s*([\d.]+)", capsys.readouterr().out).groups()
    assert kind == "vibration" and float(first) == pytest.approx(74.890, abs=2e-3)
    history = open_result(tmp_path / "results" / "rod_impact").history
    assert history["external_work"][2] == 0.0 > -1e-6 > history["external_work"][-1]


@pytest.mark.slow
def test_example_of_stages_runs(tmp_path):
    case = Case.from_toml(blocks(DOCS / "stages.md", "toml")[0], tmp_path)
    with Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    history = open_result(tmp_path / "out").history
    assert history["momentum"][204, 0] > 0.0 > history["momentum"][-1, 0]
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["elastic_energy"].max()


def test_tables_of_stages_are_named():
    quoted = re.findall(r"`([^`]+)`", prose(DOCS / "stages.md"))
    assert set(STAGE_TABLES) | set(ANALYSES) <= {word for span in quoted for word in re.findall(r"\w+", span)}


MESHES = (DOCS / "meshes.md").read_text()


@pytest.fixture
def meshes(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "meshes", tmp_path / "meshes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_commands_of_meshes_run(meshes, capfd):
    for words in program_lines(DOCS / "meshes.md"):
        assert main(words) == 0, words
    told = capfd.readouterr()
    assert told.err == ""
    assert "nodes at the place of another  4" in told.out and "This case can run." in told.out
    assert (meshes / "tower.png").stat().st_size > 5000
    for name in ("block.3mf", "block.msh"):
        np.testing.assert_allclose(read_whole(meshes / name).bar_fields["area"], 5e-7, rtol=1e-15)


def test_python_of_meshes_runs(meshes, capfd):
    (code,) = blocks(DOCS / "meshes.md", "python")
    names: dict = {}
    exec(code, names)
    assert "4 nodes merged" in capfd.readouterr().out
    assert names["case"].material["Steel"].young_modulus == pytest.approx(2.1e11)
    assert names["case"].mesh.truss.n_bars == 26


def test_tables_of_meshes_are_read(meshes):
    nodes, bars = blocks(DOCS / "meshes.md", "")
    (meshes / "a_nodes.csv").write_text(nodes)
    (meshes / "a_bars.csv").write_text(bars)
    mesh = read_whole(meshes / "a_bars.csv")
    assert mesh.bars.tolist() == [[0, 2], [1, 2], [0, 1]] and mesh.bar_fields["area"].tolist() == [1e-4, 1e-4, 5e-5]
    assert {name: list(members) for name, members in mesh.node_groups.items()} == {
        "feet": [0, 1],
        "top": [2],
        "loaded": [2],
    }


def test_table_of_formats():
    rows = re.findall(r"^\| [^|]+ \| ([^|]+) \| ([^|]+) \| ([^|]+) \|", MESHES, flags=re.MULTILINE)
    rows = [row for row in rows if row[0].startswith("`")]
    read = {"." + suffix for names, how, _ in rows if how != "no" for suffix in re.findall(r"\.(\w+)`", names)}
    written = {"." + suffix for names, _, how in rows if how != "no" for suffix in re.findall(r"\.(\w+)`", names)}
    assert (read, written) == (set(suffixes("read", "read_on")), set(suffixes("write")))


def test_actions_of_the_verb():
    named = set(re.findall(r"^\| `(\w+) ", MESHES.partition("## The verb")[2], flags=re.MULTILINE))
    parser, _ = program.make_parser()
    verb = parser._subparsers._group_actions[0].choices["mesh"]
    assert named == set(verb._subparsers._group_actions[0].choices)


RESULTS = {
    "ring_impact": ("ring_impact", ["time.end=0.04", "output.fields_every=200"]),
    "lattice_drop": ("lattice_drop", ["mesh.cells=[3,3,3]", "time.end=1e-4"]),
    "rod_impact": ("rod_impact", []),
    "rod_newmark": ("rod_impact", ["time.integrator=newmark"]),
    "pendulum": ("pendulum", []),
    "guyed_mast": ("guyed_mast", []),
}
"""Built-in case and changes of it, by the name of the folder."""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
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
            4,
            {
                "ring_impact": ["render.mp4", "render.png", "frames/frame_0000.png"],
                "guyed_mast": ["render.png"],
                "lattice_drop": ["render.html"],
            },
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
def test_commands_of_results_run(results, monkeypatch, capfd, page, number, made):
    monkeypatch.chdir(results)
    every = program_lines(DOCS / page)
    lines = [words for words in every if {word[8:] for word in words if word.startswith("results/")} <= set(RESULTS)]
    assert len(lines) == number
    for words in lines:
        if words[0] in RESULTS:
            words += ["--set", "output.fields_every=0", "time.end=0.04", "--quiet"]
        if "--html" in words:
            pytest.importorskip("plotly")
        if words[0] == "render" and "--html" not in words:
            words += ["--frames", "3", "--size", "480x270"]
        assert main(words) == 0, (words, capfd.readouterr().err)
    for name, files in made.items():
        for file in files:
            path = results / "results" / name / file
            assert path.stat().st_size > 2000, path
            if path.suffix == ".png":
                assert min(Image.open(path).size) > 200


TUTORIAL = DOCS / "tutorial.md"


BLOCK = re.compile(r"^```(toml|python|bash)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)


STAND_INS = {
    "python": f'exec "{sys.executable}" "$@"',
    "module": "exit 0",
    "srun": 'exec mpirun -n 2 "$@"',
    "sbatch": 'echo "submitted $1"',
}
"""Commands of a cluster that this machine may not have."""


def run_tutorial(folder: Path) -> dict[str, str]:
    """What each block printed, by its text, and the folder under ``""``."""
    (folder / "bin").mkdir()
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "activate").touch()
    for name, text in STAND_INS.items():
        (folder / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / "bin" / name).chmod(0o755)
    settings = {**environment(), "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    printed = {"": str(folder)}
    for language, text in BLOCK.findall(TUTORIAL.read_text()):
        if language in ("toml", "python"):
            (folder / re.match(r"# (\S+)\n", text)[1]).write_text(text)
            continue
        script = folder / ("job.sh" if text.startswith("#!") else "commands.sh")
        script.write_text(re.sub(r"--frames \d+", "--frames 2", text))  # fewer than a reader draws
        command = ["bash", "-e", script.name]
        done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{text}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
        assert "Traceback" not in done.stderr and "warning" not in done.stderr, done.stderr
        printed[text] = done.stdout
    return printed


def output(told: dict[str, str], command: str) -> str:
    return next(printed for text, printed in told.items() if command in text)


def _numbers_are_those_of_the_page(told):
    text = TUTORIAL.read_text()
    quoted = re.search(r"It prints `(force: .*?)`", text)[1]
    assert quoted == output(told, "python force.py").strip()
    info = output(told, "info results/rod_impact")
    start, end = re.search(r"kinetic energy +([\d.]+) mJ at the start.* ([\d.]+) mJ at", info).groups()
    elastic = re.search(r"elastic energy .* ([\d.]+) mJ at the end", info)[1]
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


def _mistakes_are_found_by_check(told, capsys, monkeypatch):
    monkeypatch.chdir(told[""])
    assert main(["check", "rod.toml", "--set", "section.rod.area=100.0"]) == 0
    assert "no bar has that; 1 mm2 is 1e-6 m2" in "".join(capsys.readouterr())
    assert main(["check", "rod.toml", "--set", "wall.0.normal=[1.0, 0.0, 0.0]"]) == 2
    assert "beyond the wall" in capsys.readouterr().err


def _lattice_and_job_are_those_of_the_page(told):
    assert re.search(r"bars +7,440\n", output(told, "mpirun -n 2 python -m pfem_petsc drop.toml\n"))
    again = output(told, "--restart --set time.end=1e-4")
    assert "changed: time.end: 6e-05 -> 0.0001" in again and re.search(r"done: 4\d steps in .* t = 100\.\d µs", again)
    bars = re.search(r"bars +([\d,]+)", output(told, "mesh.cells=[12,12,16]"))[1]
    assert f"{bars} bars" in TUTORIAL.read_text()
    job = output(told, "#SBATCH")
    assert "done:" in job and "submitted" not in job


def _files_of_the_page_are_written(told):
    results = Path(told[""]) / "results"
    for name in ("energies.png", "momentum.png", "walls.png", "render.mp4", "render.png"):
        assert (results / "rod_impact" / name).stat().st_size > 1000, name
    assert (results / "rod-sweep" / "sweep.csv").read_text().count("\n") == 3
    newmark = (results / "newmark" / "curves.png").stat().st_size
    assert newmark > 1000


@pytest.mark.slow
def test_tutorial(tmp_path, capsys, monkeypatch):
    """One test, as the blocks of the page need those before them and take longer than all that is asserted of them."""
    told = run_tutorial(tmp_path)
    _numbers_are_those_of_the_page(told)
    _lattice_and_job_are_those_of_the_page(told)
    _files_of_the_page_are_written(told)
    _mistakes_are_found_by_check(told, capsys, monkeypatch)


@pytest.mark.slow
def test_figures_are_drawn(tmp_path):
    drawn = {path.name: Image.open(path).size for path in theory_figures.main(tmp_path)}
    shown = re.findall(r"images/theory/(\w+\.png)", (DOCS / "theory.md").read_text())
    assert sorted(shown) == sorted(drawn)
    for name in shown:
        assert Image.open(theory_figures.FOLDER / name).size == pytest.approx(drawn[name], rel=0.02)


LOADS = {"src", "srcset", "poster", "data"}
"""Attributes whose content a browser loads by itself."""


class Page(HTMLParser):
    """Anchors of a page, what it links to, and what a browser loads for it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.links, self.loads = set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.anchors.update(named[key] for key in ("id", "name") if named.get(key))
        self.loads += [value for key, value in attrs if key in LOADS and value]
        if named.get("href"):
            (self.links if tag == "a" else self.loads).append(named["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> dict[Path, Page]:
    folder = tmp_path_factory.mktemp("site")
    script = (ROOT / "scripts" / "docs.sh").read_text()
    options = re.search(r'^"\$python" (-m sphinx .*)$', script, flags=re.MULTILINE)[1]
    assert {"-W", "-n"} <= set(options.split())  # warnings are errors, and so are references to nothing
    command = shlex.split(options.replace("$folder", str(folder / "html")))
    done = subprocess.run(
        [sys.executable, *command],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-8000:]
    assert not done.stderr
    return {path: Page(path.read_text()) for path in (folder / "html").rglob("*.html")}


@pytest.mark.slow
def test_every_page_is_there(site):
    names = {path.stem for path in site}
    assert {page.stem for page in [*ROOT.glob("docs/*.md"), *ROOT.glob("*.md")]} <= names


@pytest.mark.slow
def test_nothing_is_loaded_from_the_network(site):
    folder = next(path for path in site if path.name == "search.html").parent
    for path, page in site.items():
        for target in page.loads:
            assert not re.match(r"(\w+:)?//", target), (path, target)
        assert not re.search(r"mathjax[\w./-]*\.js", path.read_text(), flags=re.IGNORECASE), path
    for sheet in folder.rglob("*.css"):
        assert not re.search(r"(@import\s+|url\()['\"]?(\w+:)?//", sheet.read_text()), sheet


@pytest.mark.slow
def test_links_of_the_site_lead_somewhere(site):
    """Scripts of the theme make the anchors of the empty link and of the list of results."""
    for path, page in site.items():
        for target in page.links:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc or target == "#":
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert file.exists(), (path.name, target)
            if parts.fragment and file in site:
                assert unquote(parts.fragment) in site[file].anchors, (path.name, target)


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site):
    anchors = next(page for path, page in site.items() if path.name == "api.html").anchors
    assert {f"pfem_petsc.{name}" for name in pfem_petsc.__all__ if not name.startswith("_")} <= anchors
    assert {
        "pfem_petsc.Simulation.residual",
        "pfem_petsc.Case.update",
        "pfem_petsc.output.result.Result.grid",
    } <= anchors


@pytest.mark.slow
def test_formulas_are_drawn_by_the_browser(site):
    text = next(path for path in site if path.name == "theory.html").read_text()
    assert text.count("<math") > 20 and "$$" not in text


@pytest.fixture
def mathml(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    return importlib.import_module("mathml").mathml


def test_formulas_keep_accents_and_fractions(mathml):
    """An index of a letter with a dot stands beside it, and fractions have their denominator."""
    made = re.sub(r"\s+", "", mathml(r"{\dot\varepsilon}_p = \hat{x}_{n+1} + \sum_{k}^n y", True))
    accent = '<moveraccent="true"><mi>ε</mi><mostretchy="false">˙</mo></mover>'
    assert f"<msub>{accent}<mi>p</mi></msub>" in made and made.count("<munderover>") == 1  # of the sum
    assert "<mrow><mi>n</mi><mo>+</mo><mn>1</mn></mrow></msub>" in made
    half = re.sub(r"\s+", "", mathml(r"\tfrac{1}{2} m", False))
    assert "<mn>1</mn><mn>2</mn></mfrac>" in half
    with pytest.raises(MathError, match="in braces"):
        mathml(r"\tfrac12 m", False)
