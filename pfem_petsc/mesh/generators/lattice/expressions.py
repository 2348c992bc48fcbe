"""Expressions of coordinates in case files, such as ``"1e-6*(1 + 2*exp(-z/0.1))"``, and what their values at points
are computed from; nothing of them is run as code."""

from __future__ import annotations

import ast
import keyword
import math
import warnings
from collections.abc import Callable, Mapping
from functools import cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....case.base import is_finite_number
from ....errors import InputError
from ....files import readable_whole

if TYPE_CHECKING:
    import pyvista

COORDINATES = ("x", "y", "z")

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


def can_be_variable(name: str) -> bool:
    """Whether expressions can use a name for a variable besides the coordinates."""
    return name.isidentifier() and not keyword.iskeyword(name) and name not in {*COORDINATES, *_CONSTANTS, *_FUNCTIONS}


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

    def __init__(self, text: str, variables: tuple[str, ...] = COORDINATES) -> None:
        self.text, self.variables = text, variables
        if len(text) > _LONGEST:
            raise ValueError(f"the expression has {len(text)} characters, more than {_LONGEST}")
        # each node of the tree before its parts, the last part first; without recursion, for long sums
        self._steps: list[tuple[str | Callable[..., Any], int]] = []
        try:
            left: list[ast.AST] = [ast.parse(text.strip(), mode="eval").body]
            while left:
                function, parts = self._step(left.pop())
                self._steps.append((function, len(parts)))
                left += parts
        except SyntaxError as error:
            raise ValueError(f"not an expression: {error.msg} at character {error.offset}") from None
        except (RecursionError, MemoryError):
            raise ValueError("the expression is nested too deep") from None
        self.used = {function for function, _ in self._steps if isinstance(function, str)}

    def __call__(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the values (n,) float64 at the values (n,) of the variables; not finite where it is not defined."""
        found: list[Any] = []
        with np.errstate(all="ignore"):
            for function, count in reversed(self._steps):
                parts = found[len(found) - count :]
                del found[len(found) - count :]
                value = values[function] if isinstance(function, str) else function(*parts)
                found.append(np.asarray(value, dtype=float))  # 1 and 0 for true and false
        return np.broadcast_to(found[0], len(next(iter(values.values())))).copy()

    def _step(self, node: ast.AST) -> tuple[str | Callable[..., Any], list[Any]]:
        """Return what gives the value of a node of the tree, a variable or a function of its parts, and these."""
        match node:
            case ast.Constant(value):
                if not is_finite_number(value):
                    raise ValueError(f"{ast.unparse(node)} is not a number")
                return lambda: float(value), []
            case ast.Name(name):
                if name in self.variables:
                    return name, []
                if name not in _CONSTANTS:
                    known = ", ".join((*self.variables, *_CONSTANTS))
                    raise ValueError(f"unknown variable {name!r}; known: {known}")
                return lambda: _CONSTANTS[name], []
            case ast.BinOp(left, operator, right):
                return self._operator(node, operator), [left, right]
            case ast.UnaryOp(operator, operand):
                return self._operator(node, operator), [operand]
            case ast.BoolOp(operator, parts):
                function = self._operator(node, operator)
                return lambda *values: reduce(function, values), parts
            case ast.Compare(left, operators, others):
                functions = [self._operator(node, operator) for operator in operators]
                return lambda *values: reduce(
                    np.logical_and, [compare(a, b) for compare, a, b in zip(functions, values, values[1:])]
                ), [left, *others]
            case ast.Call(ast.Name(name), parts, keywords):
                if name not in _FUNCTIONS:
                    raise ValueError(f"unknown function {name!r}; known: {', '.join(_FUNCTIONS)}")
                function, wanted = _FUNCTIONS[name]
                if keywords or (len(parts) != wanted if wanted > 0 else len(parts) < -wanted):
                    expected = f"{wanted} argument{'s' * (wanted > 1)}" if wanted > 0 else "two or more arguments"
                    raise ValueError(f"{name} takes {expected}, got {len(parts) + len(keywords)}")
                return function, parts
        raise ValueError(f"{ast.unparse(node)!r} is not arithmetic of numbers, variables and known functions")

    @staticmethod
    def _operator(node: ast.AST, operator: ast.AST) -> Callable[..., Any]:
        if type(operator) not in _OPERATORS:
            hint = "; powers are **" if isinstance(operator, ast.BitXor) else ""
            raise ValueError(f"{ast.unparse(node)!r}: this operator is not known{hint}")
        return _OPERATORS[type(operator)]


def read_vtk(path: Path, where: str) -> Any:
    """Return what VTK reads from a file: nothing, or data without cells, from one that is damaged.

    Raises
    ------
    InputError
        Beginning with ``where``, if the file cannot be opened, or VTK cannot read it.
    """
    import pyvista
    from vtkmodules.vtkCommonCore import vtkObject

    vtkObject.GlobalWarningDisplayOff()  # messages of VTK beside those of this program
    try:
        with warnings.catch_warnings(record=True):
            return pyvista.read(readable_whole(path))
    except OSError as error:
        raise InputError(f"{where}: cannot open: {error.strerror or error}") from None
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{where}: cannot be read: {error}") from None
    finally:
        vtkObject.GlobalWarningDisplayOn()


class MeshField:
    """A field on a mesh of VTK, such as densities of a topology optimisation, whose file every rank reads at first use.

    Parameters
    ----------
    key : of the table of the field, for messages
    file, array : names
    scale : metres per unit of length of the file
    """

    def __init__(self, key: str, file: str, array: str, scale: float) -> None:
        self._key, self._path, self._array, self._scale = key, Path(file), array, scale

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the values (n,) at points (n, 3) [m]: those of the nearest point of the mesh for points outside it.

        Raises
        ------
        InputError
            If the file cannot be read, or has no such array of numbers.
        """
        import pyvista

        if len(points) == 0:
            return np.empty(0)
        mesh, array, places = self._mesh, self._array, points / self._scale
        found = pyvista.PolyData(places).sample(mesh)
        values = np.array(found.point_data[array], dtype=float)
        outside = np.flatnonzero(np.asarray(found.point_data["vtkValidPointMask"]) == 0)
        if len(outside):
            at_points = mesh if array in mesh.point_data else mesh.cell_data_to_point_data()
            nearest = [mesh.find_closest_point(place) for place in places[outside]]
            values[outside] = np.asarray(at_points.point_data[array])[nearest]
        return values

    @cached_property
    def _mesh(self) -> pyvista.DataSet:
        import pyvista

        path, array, where = self._path, self._array, f"{self._key}.file: {self._path}"
        mesh = read_vtk(path, where)
        if not isinstance(mesh, pyvista.DataSet) or mesh.n_cells == 0:
            raise InputError(f"{where}: has no cells to take a field from")
        of_points = array in mesh.point_data
        data = mesh.point_data if of_points else mesh.cell_data
        if array not in data or data[array].ndim != 1 or data[array].dtype.kind not in "fiu":
            known = [name for some in (mesh.point_data, mesh.cell_data) for name in some if some[name].ndim == 1]
            there = f"; it has {', '.join(known)}" if known else ""
            raise InputError(f"{self._key}.array = {array!r}: {path} has no such array of single numbers{there}")
        if of_points and array in mesh.cell_data:
            del mesh.cell_data[array]
        return mesh


class Fields:
    """The expressions of a lattice, by their keys in ``[mesh]``, and the fields that they use.

    Raises
    ------
    ValueError
        If one is no expression of coordinates and fields; it names the key.
    """

    def __init__(self, texts: Mapping[str, str], fields: Mapping[str, MeshField]) -> None:
        self._fields, self._expressions = fields, {}
        for key, text in texts.items():
            try:
                self._expressions[key] = Expression(text, (*COORDINATES, *fields))
            except ValueError as error:
                raise ValueError(f"{key} = {text!r}: {error}") from None

    def at(self, points: np.ndarray, key: str) -> np.ndarray:
        """Return the values (n,) of an expression at points (n, 3) [m].

        Raises
        ------
        InputError
            If the expression has no finite value somewhere.
        """
        expression = self._expressions[key]
        variables = dict(zip(COORDINATES, points.T))
        variables |= {name: field(points) for name, field in self._fields.items() if name in expression.used}
        values = expression(variables)
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            where = ", ".join(f"{x:.6g}" for x in points[bad[0]])
            raise InputError(f"mesh.{key} = {expression.text!r} has no finite value at ({where}) m")
        return values
