"""Every function of the package and the scripts has types, except compiled loops.

ruff requires them too, but does not recognise compiled loops, so files with such loops are exempt there as a whole.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
COMPILED = {"addressed", "kernel", "law_kernel", "inlined", "intrinsic", "njit", "overload", "register_jitable"}
"""Decorators of functions whose types Numba infers."""


def is_compiled(function: ast.FunctionDef) -> bool:
    decorators = (part.func if isinstance(part, ast.Call) else part for part in function.decorator_list)
    return any((part.id if isinstance(part, ast.Name) else part.attr) in COMPILED for part in decorators)


def untyped(node: ast.AST) -> Iterator[str]:
    """Line and name of each argument without a type, and of each function whose result has none."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            if is_compiled(child):
                continue
            given = child.args
            every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            for argument in every:
                if argument is not None and argument.annotation is None and argument.arg not in ("self", "cls"):
                    yield f"{argument.lineno}: {child.name}({argument.arg})"
            if child.returns is None:
                yield f"{child.lineno}: {child.name} -> ?"
        yield from untyped(child)


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["pfem_petsc", "scripts"])
def test_functions_are_typed(folder):
    files = sorted((ROOT / folder).rglob("*.py"))
    assert len(files) > 20
    assert [f"{path}:{what}" for path in files for what in untyped(ast.parse(path.read_text()))] == []


@pytest.mark.parametrize(
    "text, found",
    [
        ("def f(x): return x", ["1: f(x)", "1: f -> ?"]),
        ("def f(x: int) -> int: return x", []),
        ("@kernel\ndef f(x): return x", []),
        ("@mechanics.inlined\ndef f(x): return x", []),
        ("@staged\ndef f(*, x) -> int: return x", ["2: f(x)"]),
        ("class A:\n    def f(self, *more) -> int: return 1", ["2: f(more)"]),
        ("def f() -> int:\n    def g(x) -> int: return x\n    return g(1)", ["2: g(x)"]),
    ],
)
def test_what_lacks_a_type_is_found(text, found):
    assert list(untyped(ast.parse(text))) == found
