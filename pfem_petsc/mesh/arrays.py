"""A mesh from arrays that a user gives, checked for shapes and types."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .slab import MeshSlab

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["slab_from_arrays"]


def slab_from_arrays(
    source: str,
    points: ArrayLike,
    bars: ArrayLike,
    node_groups: Mapping[str, ArrayLike],
    bar_groups: Mapping[str, ArrayLike],
    bar_fields: Mapping[str, ArrayLike],
) -> MeshSlab:
    """Return the slab of one rank that has the whole mesh; ``source`` names it in messages.

    Raises
    ------
    InputError
        For arrays of wrong shape or type, and members of groups that do not exist.
    """
    nodes, ends = _array(source, "points", points, 3, "fiu"), _array(source, "bars", bars, 2, "iu")
    return MeshSlab(
        n_nodes=len(nodes),
        n_bars=len(ends),
        first_node=0,
        points=nodes.astype(np.float64),
        first_bar=0,
        bars=ends.astype(np.int64),
        node_groups={name: _members(source, "node_groups", name, m, len(nodes)) for name, m in node_groups.items()},
        bar_groups={name: _members(source, "bar_groups", name, m, len(ends)) for name, m in bar_groups.items()},
        bar_fields={name: _field(source, name, values, len(ends)) for name, values in bar_fields.items()},
        source=source,
    )


def _array(where: str, name: str, values: ArrayLike, width: int, kinds: str) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.empty(0, object)  # rows of different lengths
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in kinds:
        what = "positions [m]" if name == "points" else "integers, the nodes at both ends"
        raise InputError(
            f"{where}: {name} has shape {array.shape} and type {array.dtype}; expected ({name}, {width}) {what}"
        )
    return array


def _field(source: str, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the values of a cell field."""
    where = f"{source}: bar_fields[{name!r}]"
    _check_name(where, name)
    array = np.asarray(values)
    if array.shape != (n,) or array.dtype.kind not in "fiu":
        raise InputError(f"{where} has shape {array.shape} and type {array.dtype}; expected ({n},) numbers")
    return array.astype(np.float64)


def _check_name(where: str, name: str) -> None:
    if not isinstance(name, str) or not name or "/" in name or name == ".":
        raise InputError(f"{where}: expected a name without slashes")


def _members(source: str, kind: str, name: str, values: ArrayLike, n: int) -> np.ndarray:
    """Return the numbers of the members of a group, ascending."""
    where = f"{source}: {kind}[{name!r}]"
    _check_name(where, name)
    array = np.asarray(values)
    if array.dtype.kind == "b" and array.shape == (n,):
        return np.flatnonzero(array)
    if array.size == 0:
        return np.empty(0, np.int64)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise InputError(
            f"{where} has shape {array.shape} and type {array.dtype}; expected a list of numbers from 0, or ({n},) "
            "booleans"
        )
    wrong = array[(array < 0) | (array >= n)]
    if len(wrong):
        raise InputError(f"{where} has member {wrong[0]}, but numbers go from 0 to {n - 1}")
    return np.unique(array.astype(np.int64))
