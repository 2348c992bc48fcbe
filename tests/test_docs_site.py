"""The site of the documentation is built without warnings, asks the network for nothing, and has no dead link."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import document_case
import pytest
from docutils.utils.math import MathError

import pfem_petsc
from pfem_petsc.case import tables
from pfem_petsc.case.base import StrictModel
from pfem_petsc.case.model import CaseModel, WithParameters

ROOT = Path(__file__).parents[1]
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


def test_types_of_keys():
    """What the models say is what the page says: limits, vectors, rows, choices."""
    lines = {row[0]: row for row in document_case.rows(tables.Section)[0]}
    assert lines["`area`"][1:4] == ["number > 0", "m2", ""]
    assert lines["`shape`"][1] == '`"round"`, `"tube"`'
    assert lines["`material`"][3] == "*required*"
    lines = {row[0]: row for row in document_case.rows(tables.TimeKeys)[0]}
    assert lines["`safety`"][1:4] == ["number > 0, ≤ 1", "", "0.9"]
    assert lines["`damping_table`"][1:3] == ["rows of 2 numbers", "s, -"]
    lines = {row[0]: row for row in document_case.rows(tables.NodeSet)[0]}
    assert lines["`nearest`"][1:3] == ["[x, y, z]", "m"]
