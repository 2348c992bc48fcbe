"""What pages name exists: tests, messages, keys; commands are accepted by the command line, and tables by a case."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import document_case
import numpy as np
import pytest
from document_laws import BEGIN, END, text_of, undocumented
from helpers.pages import DOCS, PAGES, ROOT, blocks

import pfem_petsc
from pfem_petsc import columns
from pfem_petsc.case import tables
from pfem_petsc.case.base import StrictModel
from pfem_petsc.case.files import TableFile
from pfem_petsc.case.model import CaseModel, WithParameters
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli import main as cli
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole
from pfem_petsc.mechanics.materials.base import LAWS
from pfem_petsc.registry import KINDS, choices, lookup

ANY = "\0"
"""Stands for what a message fills in."""


def defined(tree: ast.Module) -> set[str]:
    """Names of the tests of a file, those of a class as ``Class::test``."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}::{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)}
    return found


def test_tests_named_exist():
    text = "".join(page.read_text() for page in (*DOCS.glob("*.md"), ROOT / "README.md"))
    for file, _, name in re.findall(r"\b(tests/[\w/]+\.py)(::([\w:]+))?", text):
        path = ROOT / file
        assert path.exists(), file
        if name:
            assert name in defined(ast.parse(path.read_text())), f"{file}::{name}"


def test_every_folder_of_tests_of_physics_is_verified():
    named = set(re.findall(r"tests/(\w+)/", (DOCS / "verification.md").read_text()))
    assert {"physics", "statics", "modes", "contact", "integrators", "mechanics", "restart", "random_cases"} <= named


def literals(tree: ast.AST) -> Iterator[str]:
    """Texts in a tree, with ANY for what is filled in; docstrings too, which do no harm."""
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(each.value if isinstance(each, ast.Constant) else ANY for each in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def quoted() -> list[str]:
    """The messages of docs/troubleshooting.md: code in the first column."""
    return re.findall(r"^\| `([^`]+)` \|", (DOCS / "troubleshooting.md").read_text(), flags=re.MULTILINE)


def failures() -> Iterator[tuple[str, str]]:
    """What the exceptions of exit status 3 say, where it is written at their place; modules and texts."""
    for path in sorted((ROOT / "pfem_petsc").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
                first = node.args[0]
                written = isinstance(first, ast.JoinedStr | ast.Constant)
                if node.func.id in ("SimulationFailure", "NotConverged") and written:
                    text = next(iter(literals(first)))
                    if re.search(r"[a-z]{3}", text):  # not only a place, and the failure that it wraps
                        yield path.name, " ".join(text.split())


def pattern(message: str) -> re.Pattern[str]:
    """Parts of a quoted message, between dots, follow one another in one text of the code."""
    parts = [re.escape(part.strip()) for part in message.replace("\\|", "|").split("...") if part.strip()]
    return re.compile(r"[^\n]*?".join(parts))


@pytest.mark.slow
def test_every_failure_is_listed():
    """A new message of a run that fails needs a row in docs/troubleshooting.md."""
    patterns = [pattern(message) for message in quoted()]
    told = list(failures())
    assert len(told) > 40
    missing = [(file, text) for file, text in told if not any(each.search(text) for each in patterns)]
    assert not missing


@pytest.fixture(scope="module")
def messages() -> str:
    trees = [ast.parse(path.read_text()) for path in (ROOT / "pfem_petsc").rglob("*.py")]
    return "\n".join(" ".join(text.split()) for tree in trees for text in literals(tree))


@pytest.mark.slow
def test_messages_are_those_of_the_program(messages):
    assert len(quoted()) > 50 and len(set(quoted())) == len(quoted())
    for message in quoted():
        assert pattern(message).search(messages), message
        assert len(message) > 10, message


COMMAND = re.compile(r"(?:mpirun -n \d+ |srun )?\bpython -m pfem_petsc ([^\n`#]*)")


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
        if page.name not in ("extending.md", "tutorial.md", "recipes.md") and 'kind = "..."' not in text
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
    elif path.suffix == ".stl":
        path.write_text("solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\nendsolid\n")


def test_tables_are_accepted(tmp_path):
    shown = fragments()
    assert len(shown) > 15
    for page, text in shown:
        try:
            Case.from_dict(completed(tomllib.loads(text), tmp_path), folder=tmp_path)
        except InputError as error:
            raise AssertionError(f"{page}:\n{text}") from error


def test_shell_reads_the_blocks(tmp_path):
    """Synopses apart, whose brackets and dots mean what may be left out; scripts that they name are there."""
    for page in PAGES:
        for text in blocks(page, "bash", ""):
            if re.search(r"^(\S+=\S+ )?(bash|python|mpirun|source|#!)", text) and not re.search(r"\[-|\.\.\.", text):
                (tmp_path / "block.sh").write_text(text)
                done = subprocess.run(["bash", "-n", "block.sh"], cwd=tmp_path, capture_output=True, text=True)
                assert done.returncode == 0, (page, text, done.stderr)
                for script in re.findall(r"\bscripts/[\w/]+\.(?:py|sh)", text):
                    assert (ROOT / script).exists(), script


def test_python_blocks_are_python():
    """Those that need what is not installed too, as gmsh."""
    for page in PAGES:
        for text in blocks(page, "python"):
            ast.parse(text)


TEXT = (DOCS / "case_file.md").read_text()


ELSEWHERE = ("[[wall]]", "[[constraint]]", "[[contact_pair]]", "[contact]", "[material.", "Columns")
"""Tables that have a page or section of their own."""


MODELS = [
    model
    for heading, models in document_case.TABLES.items()
    for model in models
    if isinstance(model, type) and not heading.startswith(ELSEWHERE)
] + [lookup("pfem_petsc.mesh.generators", name, "").Parameters for name in choices("pfem_petsc.mesh.generators")]


def named(text: str) -> set[str]:
    quoted = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    return {word for span in quoted for word in re.findall(r"\w+", span)}


def test_every_key_is_named():
    for model in MODELS:
        assert set(model.model_fields) - {getattr(model, "slot", None)} <= named(TEXT), model
    assert set(TableFile.model_fields) <= named((DOCS / "loads.md").read_text())
    assert set(tables.Rupture.model_fields) <= named((DOCS / "rupture.md").read_text())
    statics = "".join(path.read_text() for path in sorted(DOCS.glob("statics*.md")))
    for folder, text in (("contact.walls", (DOCS / "contact.md").read_text()), ("statics.methods", statics)):
        for kind in choices(f"pfem_petsc.{folder}"):
            assert set(lookup(f"pfem_petsc.{folder}", kind, "").Parameters.model_fields) <= named(text), kind
    assert {law: undocumented(law) for law in choices(LAWS)} == {law: [] for law in choices(LAWS)}


def test_keys_of_laws_are_those_of_their_parameters():
    """What ``scripts/document_laws.py`` writes, law by law; a law that it has not seen yet is no fault."""
    made = TEXT.partition(BEGIN)[2].partition(END)[0]
    documented = re.findall(r"^#### `(\w+)`$", made, flags=re.MULTILINE)
    assert {"elastic", "elastoplastic", "voce", "johnson_cook"} <= set(documented)
    for law in ("", *documented):
        assert text_of(law) in made, f"{law or 'every material'}: run scripts/document_laws.py"


def test_example_is_read(tmp_path):
    case = Case.from_toml(re.search(r"^```toml\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1], tmp_path)
    assert [load.force for load in case.load] == [(0.0, 0.0, -5e4)]
    mesh = read_whole(DOCS.parent / "meshes" / case.mesh.file.name)
    assert {"left", "right"} <= set(mesh.node_groups)
    assert {"chords"} <= set(mesh.bar_groups)
    assert case.temperature[0].bars == case.section["chord"].bars == "chords"


def models() -> Iterator[type[StrictModel]]:
    """Every model with keys of a case file, however it is found, but those of modules that tests have removed."""
    folders = r"\.(case|contact\.(walls|constraints)|integrators|materials|generators|lattices|methods)\."
    for module in pkgutil.walk_packages(pfem_petsc.__path__, "pfem_petsc."):
        if re.search(folders, module.name):
            importlib.import_module(module.name)
    waiting = [StrictModel]
    while waiting:
        waiting += (made := waiting.pop().__subclasses__())
        yield from (model for model in made if _is_there(model))


def _is_there(model: type) -> bool:
    file = getattr(sys.modules.get(model.__module__), "__file__", None)
    return file is not None and Path(file).exists()


def test_reference_lists_every_key():
    text = document_case.page()
    listed = {line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| `")}
    assert len(listed) > 150
    # assembled from those that the page has; and a public class for each base
    assembled = {CaseModel, *WithParameters.__subclasses__()}
    for model in models():
        if model not in assembled and model.__module__.startswith("pfem_petsc"):
            assert {f"`{key}`" for key in model.model_fields} <= listed, model


def test_reference_says_what_each_key_means():
    rows = [line for line in document_case.page().splitlines() if line.startswith("| `")]
    for row in rows:
        key, kind, _, _, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1])
        assert kind and (meaning or key == "`name`"), row


FILES_OF_RUNS = {"job", "inp", "log", "txt", "result", "vtkhdf", "mpirun", "restart"}
"""Words of docs/coming_from.md for files and commands."""


def test_words_of_other_programs_have_words_here():
    """Every word of the right columns of docs/coming_from.md is a key or value of a case, a module or a column."""
    rows = re.findall(r"^\| [^|]+ \| (.+) \|$", (DOCS / "coming_from.md").read_text(), flags=re.MULTILINE)
    used = {
        word for row in rows for span in re.findall(r"`([^`]+)`", row) for word in re.findall(r"[A-Za-z_]\w+", span)
    }
    known = named(document_case.page()) | {name for package in KINDS for name in choices(package)}
    assert len(rows) > 55 and len(used) > 90
    assert used <= known | {energy.name for energy in columns.ENERGIES} | {"energy_imbalance"} | FILES_OF_RUNS


def test_types_of_keys():
    """What the models say is what the page says: limits, vectors, rows, choices."""
    lines = {row[0]: row for row in document_case.rows(tables.Section)[0]}
    assert lines["`area`"][1:4] == ["number > 0", "m2", ""]
    assert lines["`shape`"][1] == '`"round"`, `"tube"`, `"angle"`, `"box"`, `"I"`, `"channel"`'
    assert lines["`material`"][3] == "*required*"
    lines = {row[0]: row for row in document_case.rows(tables.TimeKeys)[0]}
    assert lines["`safety`"][1:4] == ["number > 0, ≤ 1", "", "0.9"]
    assert lines["`damping_table`"][1:3] == ["rows of 2 numbers", "s, -"]
    lines = {row[0]: row for row in document_case.rows(tables.NodeSet)[0]}
    assert lines["`nearest`"][1:3] == ["[x, y, z]", "m"]
