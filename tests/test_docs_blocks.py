"""Commands that pages show are accepted by the command line, and tables that they show by a case.

Blocks that are run: test_docs_python.py, test_docs_pictures.py, test_docs_meshes.py, test_docs_tutorial.py,
test_readme.py, test_docs_case_file.py, contributing/.
"""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Simulation
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli import main as cli
from pfem_petsc.errors import InputError

ROOT = Path(__file__).parents[1]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
COMMAND = re.compile(r"(?:mpirun -n \d+ |srun )?\bpython -m pfem_petsc ([^\n`#]*)")


def blocks(page: Path, language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return [text for name, text in fenced if name == language]


def commands() -> Iterator[tuple[str, str]]:
    """Commands in blocks and in the text, without the synopsis, which has brackets."""
    for page in PAGES:
        for words in COMMAND.findall(page.read_text().replace("\\\n", " ")):
            if not re.search(r"\[-|\.\.\.|\w\|\w", words):
                yield page.name, words.partition("||")[0].strip()


def accept(words: str) -> None:
    split = shlex.split(words)
    cut = split.index("--") if "--" in split else len(split)
    if split[:1] in ([], ["VERB"]) or "--help" in split or split[-1] in ("--set", "--vary"):  # goes on in the next line
        return
    arguments, _ = cli._parse(split[:cut])
    if getattr(arguments, "case", None) in built_in_cases():
        Case.load(arguments.case, arguments.overrides)


def test_commands_are_accepted():
    shown = sorted(set(commands()))
    assert len(shown) > 30
    for page, words in shown:
        try:
            accept(words)
        except InputError as error:
            raise AssertionError(f"{page}: {words}") from error


def fragments() -> list[tuple[str, str]]:
    return [
        (page.name, text)
        for page in PAGES
        for text in blocks(page, "toml")
        if page.name not in ("CONTRIBUTING.md", "tutorial.md") and 'kind = "..."' not in text
    ]


def completed(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A case with a fragment: what it refers to is there."""
    named: dict[str, set[str]] = {"node_set": set(), "material": set()}

    def look(value: Any, key: str = "") -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                look(inner, name)
        elif isinstance(value, list) and key not in ("first", "second", "between"):
            for inner in value:
                look(inner, key)
        elif key in ("node_set", "first", "second", "between", "material"):
            found = {value} if isinstance(value, str) else set(value)
            named["material" if key == "material" else "node_set"] |= found
        if key.endswith("file") and isinstance(value, str):
            write_rows(folder / value)

    look(case)
    case = {"mesh": {"generator": "rod", "length": 1.0, "elements": 2}, **case}
    for name in named["node_set"] - set(case.get("node_set", {})):
        case.setdefault("node_set", {})[name] = {"all": True}
    for name in (named["material"] | {"any"}) - set(case.get("material", {})):
        case.setdefault("material", {})[name] = {"young_modulus": 1e9, "density": 1000.0}
    case.setdefault("section", {"any": {"area": 1.0, "material": "any"}})
    for name, material in case["material"].items():
        case["material"][name] = {"young_modulus": 1e9, "density": 1000.0, **material}
    if not set(case) & {"time", "static", "stage", "modes"}:
        case["time"] = {"integrator": "newmark", "step": 1e-3, "end": 1.0}
    return case


ROWS = np.linspace(0.0, 1.0, 10)
FILES: dict[str, dict[str, np.ndarray]] = {
    "train.csv": {"time": ROWS, "axle 1": ROWS, "axle 2": ROWS},
    "record.csv": {"t": ROWS, "ax": ROWS, "ay": ROWS, "az": ROWS},
    "record.npz": {"t": ROWS, "ns": ROWS, "ud": ROWS},
    "loads.npz": {"time": ROWS, "nodes": np.arange(2), "force": np.zeros((10, 2, 3))},
}
"""Files that examples name, with what their pages say that they have."""


def write_rows(path: Path) -> None:
    columns = FILES.get(path.name)
    if columns is not None and path.suffix == ".npz":
        np.savez(path, **columns)
    elif columns is not None:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")


def test_tables_are_accepted(tmp_path):
    shown = fragments()
    assert len(shown) > 15
    for page, text in shown:
        try:
            Case.from_dict(completed(tomllib.loads(text), tmp_path), folder=tmp_path)
        except InputError as error:
            raise AssertionError(f"{page}:\n{text}") from error


def shell_blocks() -> list[Any]:
    found = [(page, text) for page in PAGES for text in (*blocks(page, "bash"), *blocks(page, ""))]
    commands = [(page, text) for page, text in found if re.search(r"^(\S+=\S+ )?(bash|python|mpirun|source|#!)", text)]
    return [pytest.param(text, id=f"{page.stem}-{k}") for k, (page, text) in enumerate(commands)]


@pytest.mark.parametrize("text", shell_blocks())
def test_shell_reads_the_block(text, tmp_path):
    """Synopses apart, whose brackets and dots mean what may be left out; scripts that it names are there."""
    if not re.search(r"\[-|\.\.\.", text):
        (tmp_path / "block.sh").write_text(text)
        done = subprocess.run(["bash", "-n", "block.sh"], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    for script in re.findall(r"\bscripts/[\w/]+\.(?:py|sh)", text):
        assert (ROOT / script).exists(), script


@pytest.mark.slow
def test_example_of_modes_runs(tmp_path, monkeypatch, capsys):
    (text,) = blocks(ROOT / "docs" / "modes.md", "python")
    monkeypatch.chdir(tmp_path)
    with Simulation(Case.load("taut_cable"), MPI.COMM_SELF, quiet=True) as simulation:
        simulation.run()
    exec(compile(text, "modes.md", "exec"), {})
    kind, first = re.match(r"(\w+) \[\s*([\d.]+)", capsys.readouterr().out).groups()
    assert kind == "vibration" and float(first) == pytest.approx(74.890, abs=2e-3)


def test_python_blocks_are_python():
    """Those that need what is not installed too, as gmsh."""
    for page in PAGES:
        for text in blocks(page, "python"):
            ast.parse(text)
