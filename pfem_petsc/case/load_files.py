"""Forces over time on many nodes or node sets from one file.

NPZ files have the arrays ``time`` (n,) [s], ``nodes`` (m,) with node numbers of the mesh, and ``force``: (n, m, 3) [N],
or (m, 3) [N] that are constant or multiplied by ``factor`` (n, m). Instead of ``nodes`` and ``force`` they may have
an array (n, 3) for each node set, with its name. CSV files have a heading: the time first, then ``NAME.x``,
``NAME.y``, ``NAME.z`` for node sets or node numbers, in any order; components that are missing are zero.

The resolved case has the name of the file and a digest of its content, which is compared when the file is read.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..files import check_contents, readable_whole
from .columns import file_columns

__all__ = ["Forces", "digest_of", "read_forces"]

_COMPONENT = re.compile(r"(.+)\.([xyz])")


class Forces(NamedTuple):
    """The content of a file.

    Attributes
    ----------
    times : (n,) [s]; one for constant forces
    targets : m node numbers, or names of node sets
    values : (n, k) columns over time
    columns : (e,) the column of each entry
    members : (e,) the target of each entry
    forces : (e, 3) [N]: an entry is a force times its column
    """

    times: np.ndarray
    targets: list[int | str]
    values: np.ndarray
    columns: np.ndarray
    members: np.ndarray
    forces: np.ndarray


def digest_of(path: Path) -> str:
    """Return a digest of the content of a file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        with readable_whole(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        raise InputError(f"this file cannot be read: {error}") from error


def read_forces(path: Path, digest: str) -> Forces:
    """Read a file of forces.

    Parameters
    ----------
    path : CSV or NPZ file
    digest : of the content that the case was checked with

    Raises
    ------
    InputError
        If the file has changed, or is not as expected; the message does not name file and key.
    """
    if digest_of(path) != digest:
        raise InputError(
            f"this file is not the one that the case was made with (digest {digest[:12]}...): restore it, or start a "
            "new run without the key digest"
        )
    if not zipfile.is_zipfile(path):
        return _from_text(path)
    try:
        with np.load(path, allow_pickle=False) as found:
            check_contents(found.zip)
            arrays = {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise InputError(f"this file cannot be read: {error}") from error
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputError(f"array {name!r} has the type {array.dtype}: expected numbers")
    return _from_arrays(arrays)


def _from_arrays(arrays: dict[str, np.ndarray]) -> Forces:
    if "force" not in arrays and "nodes" not in arrays:
        names = [name for name in arrays if name != "time"]
        if not names:
            raise InputError("expected the arrays time, nodes, force, or time and one array (n, 3) for each node set")
        times = _times(arrays)
        for name in names:
            _shape(name, arrays[name], (len(times), 3))
        return _histories(times, [_target(name) for name in names], np.stack([arrays[n] for n in names], axis=1))
    for name in ("force", "nodes"):
        if name not in arrays:
            raise InputError(f"there is no array {name!r}; the file has {', '.join(arrays)}")
    unknown = [name for name in arrays if name not in ("time", "nodes", "force", "factor")]
    if unknown:
        raise InputError(f"there is an unknown array {unknown[0]!r}; expected time, nodes, force, factor")
    nodes, force = arrays["nodes"], np.asarray(arrays["force"], dtype=np.float64)
    if nodes.ndim != 1 or nodes.dtype.kind not in "iu" or not len(nodes):
        raise InputError("array 'nodes': expected node numbers (m,)")
    if len(np.unique(nodes)) < len(nodes):
        raise InputError("array 'nodes': a node number is listed twice")
    if force.ndim == 3:
        if "factor" in arrays:
            raise InputError("array 'factor' requires forces (m, 3)")
        times = _times(arrays)
        _shape("force", force, (len(times), len(nodes), 3))
        return _histories(times, nodes.tolist(), force)
    _shape("force", force, (len(nodes), 3))
    _check_finite(force, "array 'force'")
    every = np.arange(len(nodes))
    if "factor" not in arrays:
        if "time" in arrays:
            raise InputError("array 'time' needs forces (n, m, 3), or an array factor (n, m)")
        return Forces(np.zeros(1), nodes.tolist(), np.ones((1, 1)), np.zeros_like(every), every, force)
    times, factor = _times(arrays), np.asarray(arrays["factor"], dtype=np.float64)
    _shape("factor", factor, (len(times), len(nodes)))
    _check_finite(factor, "array 'factor'")
    return Forces(times, nodes.tolist(), factor, every, every, force)


def _from_text(path: Path) -> Forces:
    file = file_columns(path)
    targets: dict[int | str, int] = {}
    found: list[tuple[int, int, int]] = []
    for k in range(1, file.count):
        match = _COMPONENT.fullmatch(file.names[k] or "")
        if match is None:
            raise InputError(
                f"column {k} has the heading {file.names[k] or ''!r}: expected NAME.x, NAME.y or NAME.z, with a node "
                "set or a node number as NAME"
            )
        member = targets.setdefault(_target(match[1]), len(targets))
        found.append((k, member, "xyz".index(match[2])))
    if not found:
        raise InputError("expected the time and columns NAME.x, NAME.y, NAME.z, with a heading")
    if len({each[1:] for each in found}) < len(found):
        raise InputError("two columns have the same heading")
    times = _checked_times(file.values(0), file.where)
    values = np.array([file.values(k) for k, _, _ in found]).T
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise InputError(f"{file.where(int(bad[0]))}: expected finite numbers")
    members = np.array([member for _, member, _ in found])
    forces = np.eye(3)[[component for _, _, component in found]]
    return Forces(times, list(targets), values, np.arange(len(found)), members, forces)


def _target(name: str) -> int | str:
    return int(name) if re.fullmatch(r"\d{1,18}", name) else name


def _histories(times: np.ndarray, targets: list[int | str], force: np.ndarray) -> Forces:
    """Forces (n, m, 3), each component a column."""
    m = len(targets)
    values = np.asarray(force, dtype=np.float64).reshape(len(times), 3 * m)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        member = int(np.flatnonzero(~np.isfinite(values[bad[0]]))[0]) // 3
        raise InputError(f"row {bad[0]}: the force on {targets[member]!r} is not finite")
    every = np.arange(3 * m)
    return Forces(times, targets, values, every, every // 3, np.tile(np.eye(3), (m, 1)))


def _times(arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "time" not in arrays:
        raise InputError(f"there is no array 'time'; the file has {', '.join(arrays)}")
    times = np.asarray(arrays["time"], dtype=np.float64)
    if times.ndim != 1 or not len(times):
        raise InputError("array 'time': expected times (n,)")
    return _checked_times(times, lambda row: f"row {row}")


def _checked_times(times: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    if not np.isfinite(times).all():
        raise InputError(f"{where(int(np.flatnonzero(~np.isfinite(times))[0]))}: the time is not finite")
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        k = int(late[0])
        raise InputError(
            f"{where(k + 1)}: times must increase, but {times[k + 1].item()!r} follows {times[k].item()!r}"
        )
    return times


def _shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(f"array {name!r} has the shape {array.shape}: expected {shape}")


def _check_finite(array: np.ndarray, what: str) -> None:
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        raise InputError(f"{what}: entry {bad[0].tolist()} is not finite")
