"""Expressions of coordinates in case files, such as ``"1e-6*(1 + 2*exp(-z/0.1))"``; nothing of them is run as code."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np

__all__ = ["RESERVED", "Expression"]

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
    ast.Not: np.logical_not,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    **{name: (getattr(np, name), 1) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "log10")},
    **{name: (getattr(np, name), 1) for name in ("sqrt", "abs", "floor", "ceil", "sign")},
    **{name: (getattr(np, f"arc{name[1:]}"), 1) for name in ("asin", "acos", "atan")},
    "atan2": (np.arctan2, 2),
    "hypot": (np.hypot, 2),
    "where": (np.where, 3),
    "min": (lambda *values: reduce(np.minimum, values), -2),
    "max": (lambda *values: reduce(np.maximum, values), -2),
}
"""Functions by name, and how many arguments they take; -2: two or more."""

_CONSTANTS = {"pi": math.pi, "e": math.e}
_LONGEST = 2000

RESERVED = (
    "x",
    "y",
    "z",
    *_CONSTANTS,
    *_FUNCTIONS,
    "and",
    "or",
    "not",
    "True",
    "False",
    "None",
    "if",
    "else",
    "in",
    "is",
)
"""Names that a variable of its own cannot have."""


class Expression:
    """An expression of named variables; ``used`` has the names in it.

    Parameters
    ----------
    text : numbers, variables, ``pi``, ``e``, ``+ - * / **``, comparisons, ``and``, ``or``, ``not``, and the functions
        sin cos tan asin acos atan atan2 sinh cosh tanh exp log log10 sqrt abs sign floor ceil hypot min max
        where(condition, value, otherwise)
    variables : their names

    Raises
    ------
    ValueError
        If the text is anything else; it says what.
    """

    def __init__(self, text: str, variables: tuple[str, ...]) -> None:
        self.text, self.variables = text, variables
        if len(text) > _LONGEST:
            raise ValueError(f"the expression has {len(text)} characters, more than {_LONGEST}")
        try:
            tree = ast.parse(text.strip(), mode="eval")
            self._nodes = self._checked(tree.body)
        except SyntaxError as error:
            raise ValueError(f"not an expression: {error.msg} at character {error.offset}") from None
        except (RecursionError, MemoryError):
            raise ValueError("the expression is nested too deep") from None
        self.used = {node.id for node, _, _ in self._nodes if isinstance(node, ast.Name)}

    def __call__(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the values (n,) float64 at the values (n,) of the variables; not finite where it is not defined."""
        n = len(next(iter(values.values())))
        found: dict[int, Any] = {}
        with np.errstate(all="ignore"):
            for node, operators, parts in reversed(self._nodes):
                found[id(node)] = self._value(node, operators, [found.pop(id(part)) for part in parts], values)
            return np.broadcast_to(np.asarray(found[id(self._nodes[0][0])], dtype=float), n).copy()

    def _checked(self, tree: ast.AST) -> list[tuple[ast.AST, list[ast.AST], list[ast.AST]]]:
        """Return all nodes, each before its parts, with operators and parts; without recursion, for long sums.

        Refuse what is not arithmetic of numbers, variables and known functions.
        """
        nodes, left = [], [tree]
        while left:
            node = left.pop()
            operators, parts = self._operands(node)
            nodes.append((node, operators, parts))
            left += parts
        return nodes

    def _operands(self, node: ast.AST) -> tuple[list[ast.AST], list[ast.AST]]:
        if isinstance(node, ast.Constant):
            if isinstance(node.value, bool) or not isinstance(node.value, int | float) or not _finite(node.value):
                raise ValueError(f"{ast.unparse(node)} is not a number")
            return [], []
        if isinstance(node, ast.Name):
            if node.id not in self.variables and node.id not in _CONSTANTS:
                raise ValueError(f"unknown variable {node.id!r}; known: {', '.join((*self.variables, *_CONSTANTS))}")
            return [], []
        operators, parts = _parts(node)
        if not all(type(operator) in _OPERATORS for operator in operators):
            hint = "; powers are **" if any(isinstance(operator, ast.BitXor) for operator in operators) else ""
            raise ValueError(f"{ast.unparse(node)!r}: this operator is not known{hint}")
        return operators, parts

    def _value(
        self, node: ast.AST, operators: list[ast.AST], found: list[Any], values: Mapping[str, np.ndarray]
    ) -> Any:
        if isinstance(node, ast.Constant):
            return float(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return values[node.id] if node.id in self.variables else _CONSTANTS[node.id]
        if isinstance(node, ast.Call):
            return _FUNCTIONS[node.func.id][0](*found)  # type: ignore[attr-defined]
        if isinstance(node, ast.Compare):
            pairs = [_OPERATORS[type(o)](a, b) for o, a, b in zip(operators, found, found[1:])]
            return _number(reduce(np.logical_and, pairs))
        if isinstance(node, ast.BoolOp):
            return _number(reduce(_OPERATORS[type(operators[0])], found))
        return _number(_OPERATORS[type(operators[0])](*found))


def _parts(node: ast.AST) -> tuple[list[ast.AST], list[ast.AST]]:
    """Return the operators of a part of an expression, and what they are applied to."""
    if isinstance(node, ast.BinOp):
        return [node.op], [node.left, node.right]
    if isinstance(node, ast.UnaryOp):
        return [node.op], [node.operand]
    if isinstance(node, ast.BoolOp):
        return [node.op], list(node.values)
    if isinstance(node, ast.Compare):
        return list(node.ops), [node.left, *node.comparators]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        name, count = node.func.id, len(node.args)
        if name not in _FUNCTIONS:
            raise ValueError(f"unknown function {name!r}; known: {', '.join(_FUNCTIONS)}")
        wanted = _FUNCTIONS[name][1]
        if node.keywords or (count != wanted if wanted > 0 else count < -wanted):
            expected = f"{wanted} argument{'s' * (wanted > 1)}" if wanted > 0 else "two or more arguments"
            raise ValueError(f"{name} takes {expected}, got {count + len(node.keywords)}")
        return [], list(node.args)
    raise ValueError(f"{ast.unparse(node)!r} is not arithmetic of numbers, variables and known functions")


def _number(value: Any) -> Any:
    """Return 1 and 0 for true and false."""
    return np.asarray(value, dtype=float)


def _finite(value: float) -> bool:
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False
