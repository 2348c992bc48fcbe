"""Pages point to things that exist, the index leads to every page, and the gallery has every built-in case."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import gallery
import pytest
from helpers.pages import DOCS, PAGES, ROOT, blocks, prose
from mpi4py import MPI
from PIL import Image
from test_layering import FLOOR, PARTS

from pfem_petsc import Simulation, __version__
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli.main import main
from pfem_petsc.registry import choices

README = (ROOT / "README.md").read_text()
COMMAND_LINE = (DOCS / "command_line.md").read_text()
CHOICES = (DOCS / "choosing.md").read_text()


def anchors(page: Path) -> set[str]:
    """As GitHub makes them of headings."""
    headings = re.findall(r"^#+ (.*)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(file), target


@pytest.mark.parametrize("page", [DOCS / "architecture.md", ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name)
def test_modules_named_exist(page):
    for path in re.findall(r"`((?:\w+/)*\w+\.(?:py|sh))`", prose(page)):
        assert "NAME" in path or any((ROOT / base / path).exists() for base in ("", "pfem_petsc")), path
    for folder in re.findall(r"^\| `(\w+)` \|", prose(page), flags=re.MULTILINE):
        assert (ROOT / "pfem_petsc" / folder).is_dir(), folder


def test_every_folder_is_on_its_floor():
    """The picture is the order that imports are checked against."""
    picture = re.search(r"^```\n(  cli/.*?)^```$", (DOCS / "architecture.md").read_text(), re.M | re.S)[1]
    rows = [re.findall(r"(\w+)(?:/|\.py)", row) for row in picture.splitlines()]
    floors = [[FLOOR[PARTS.get(name, name)] for name in row] for row in rows if row]
    folders = {name for name in (*FLOOR, *PARTS) if "." not in name}
    assert {name for row in rows for name in row} == folders - {"__init__", "__main__"}
    assert all(max(below) < min(above) for above, below in zip(floors, floors[1:], strict=False))


def names_in(file: Path) -> set[str]:
    """Functions and classes of a module, and the methods of these, as ``Class.method``."""
    found = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
            found |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
    return found


def test_stops_of_walks_exist():
    """Each walk has at most 15 stops, and each stop is a module with a name in it."""
    walks = (DOCS / "architecture.md").read_text().split("## Walks")[1].split("\n## ")[0].split("\n### ")[1:]
    assert len(walks) == 6
    for walk in walks:
        stops = re.findall(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`:", walk, flags=re.MULTILINE)
        assert 4 <= len(stops) <= 15 and len(stops) == len(re.findall(r"^\d+\. ", walk, flags=re.MULTILINE))
        for module, name in stops:
            assert name in names_in(ROOT / "pfem_petsc" / module), (module, name)


def test_index_leads_to_every_page():
    """The index of the documentation, or README; the site adds its lists of pages, and misses none (test_docs_site)."""
    found = set()
    for start in (ROOT / "README.md", DOCS / "index.md"):
        targets = re.findall(r"\]\(([^)\s#]+)", prose(start))
        found |= {(start.parent / target).resolve() for target in targets if not target.startswith("http")}
    assert set(PAGES) - {ROOT / "README.md", DOCS / "index.md"} <= found


def test_pages_lead_to_every_script():
    text = "".join(page.read_text() for page in PAGES)
    for script in sorted([*(ROOT / "scripts").glob("*.py"), *(ROOT / "scripts").glob("*.sh")]):
        if script.name not in ("environment.sh", "build_petsc.sh"):  # parts of setup.sh
            assert f"scripts/{script.name}" in text, script


def test_scripts_find_their_marks():
    """Where scripts write tables, the page has each mark once."""
    found = 0
    for script in sorted((ROOT / "scripts").glob("*.py")):
        text = script.read_text()
        pages = {DOCS / name for name in re.findall(r'\binsert\("(\w+\.md)"', text)}
        for page in pages:
            marks = re.findall(r'"(<!-- [^"]*? -->)', text)
            assert len(marks) >= 2 and all(page.read_text().count(mark + "\n") == 1 for mark in marks), script
            found += len(marks)
    assert found == 24


def test_one_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert version == __version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    # the newest heading, whether that version is released or not
    assert re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[0] == version


def test_case_file_is_the_built_in_one(tmp_path):
    (text,) = blocks(ROOT / "README.md", "toml")
    (tmp_path / "shown.toml").write_text(text)
    shown, built_in = Case.load(str(tmp_path / "shown.toml")), Case.load("rod_impact")
    assert shown.to_toml() == built_in.to_toml()


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
    synopsis = next(block for block in blocks(DOCS / "command_line.md", "") if "info RESULT" in block)
    for line in synopsis.splitlines():
        verb = re.search(r"pfem_petsc (\S+)", line)[1]
        assert main(["run" if verb == "CASE" else verb, "--help"]) == 0
        shown = capsys.readouterr().out
        for option in re.findall(r"\[(--?[\w-]+)", line):
            assert option in shown or option == "--", (verb, option)


def test_files_named_exist():
    for path in re.findall(r"`(?:bash )?((?:scripts|pfem_petsc|tests)/[\w/.]+)", README + COMMAND_LINE):
        assert (ROOT / path).exists(), path


def test_every_case_is_an_entry():
    """The numbers: tests/cases/test_built_in_cases.py."""
    assert set(gallery.entries()) == set(built_in_cases())


def test_page_is_that_of_the_entries():
    assert gallery.PAGE.read_text() == gallery.page(), "run scripts/gallery.py"


@pytest.mark.parametrize("name", sorted(gallery.entries()))
def test_entry_is_complete(name, tmp_path):
    entry = gallery.entries()[name]
    assert {"quantity", "value", "tolerance", "reference", "bars", "steps", "seconds"} <= set(entry)
    assert entry["tolerance"] <= max(0.06 * abs(entry["value"]), 1e-12)  # a number that says something
    picture = Image.open(gallery.PICTURES / f"{name}.png").convert("L")
    assert picture.size == tuple(map(int, gallery.SIZE.split("x")))
    assert sum(picture.histogram()[:128]) > 500, "an empty picture"
    if entry["bars"] < 1000:
        with Simulation(Case.load(name), MPI.COMM_SELF, output=tmp_path, quiet=True) as simulation:
            assert simulation.model.mesh.n_bars == entry["bars"]


def test_no_paragraph_is_taken_for_code():
    """Four spaces after an empty line make a code block; formulas here are LaTeX, and lists are indented by two."""
    assert re.findall(r"\n\n {4,}\S.*", (DOCS / "theory.md").read_text()) == []
