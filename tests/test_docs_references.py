"""Tests, messages and pages that the documentation names exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
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


def test_there_are_messages():
    assert len(quoted()) > 50 and len(set(quoted())) == len(quoted())


@pytest.mark.slow
def test_messages_are_those_of_the_program(messages):
    for message in quoted():
        assert pattern(message).search(messages), message
        assert len(message) > 10, message
