"""Pages point to things that exist, and the index leads to every page."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest
from test_layering import FLOOR, PARTS

from pfem_petsc import __version__

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


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


@pytest.mark.parametrize("page", [ROOT / "docs" / "architecture.md", ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name)
def test_modules_named_exist(page):
    for path in re.findall(r"`((?:\w+/)*\w+\.(?:py|sh))`", prose(page)):
        assert "NAME" in path or any((ROOT / base / path).exists() for base in ("", "pfem_petsc")), path
    for folder in re.findall(r"^\| `(\w+)` \|", prose(page), flags=re.MULTILINE):
        assert (ROOT / "pfem_petsc" / folder).is_dir(), folder


def test_every_folder_is_on_its_floor():
    """The picture is the order that imports are checked against."""
    picture = re.search(r"^```\n(  cli/.*?)^```$", (ROOT / "docs" / "architecture.md").read_text(), re.M | re.S)[1]
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
    walks = (ROOT / "docs" / "architecture.md").read_text().split("## Walks")[1].split("\n## ")[0].split("\n### ")[1:]
    assert len(walks) == 5
    for walk in walks:
        stops = re.findall(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`:", walk, flags=re.MULTILINE)
        assert 4 <= len(stops) <= 15 and len(stops) == len(re.findall(r"^\d+\. ", walk, flags=re.MULTILINE))
        for module, name in stops:
            assert name in names_in(ROOT / "pfem_petsc" / module), (module, name)


def test_index_leads_to_every_page():
    """The index of the documentation, or README; the site adds its lists of pages, and misses none (test_docs_site)."""
    found = set()
    for start in (ROOT / "README.md", ROOT / "docs" / "index.md"):
        targets = re.findall(r"\]\(([^)\s#]+)", prose(start))
        found |= {(start.parent / target).resolve() for target in targets if not target.startswith("http")}
    assert set(PAGES) - {ROOT / "README.md", ROOT / "docs" / "index.md"} <= found


def test_pages_lead_to_every_script():
    text = "".join(page.read_text() for page in PAGES)
    for script in sorted([*(ROOT / "scripts").glob("*.py"), *(ROOT / "scripts").glob("*.sh")]):
        if script.name not in ("environment.sh", "build_petsc.sh"):  # parts of setup.sh
            assert f"scripts/{script.name}" in text, script


def test_one_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert version == __version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[0] == version
