"""Comparison of a case with that of a checkpoint: which keys have changed, and which changes are allowed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..case.toml import value_text
from ..errors import InputError
from ..output.integrity import checksum
from ..parallel.natural import NaturalOrder
from .state import STATE_VERSION

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["changed_keys", "check_mesh_is_the_same", "check_version", "mesh_mark"]

FREE = ("title", "time.end", "static.end", "modes", "output", "solver")
"""Keys and tables that a restart may change: they do not change what is simulated."""

_OF_STAGES = re.compile(r"stage\[(\d+)\]\.(.*)")


def changed_keys(path: Path, before: Mapping[str, Any], now: Mapping[str, Any], source: str) -> list[str]:
    """Return the changes of a restart, ``time.end: 1.0 -> 2.0`` for every key that differs.

    Parameters
    ----------
    path : the checkpoint
    before, now : the case of the checkpoint and this one, as nested tables
    source : this case's file, for the message

    Raises
    ------
    InputError
        If a key differs that a restart cannot change.
    """
    # tuples become lists, as in the checkpoint
    old, new = (_flat(json.loads(json.dumps(case))) for case in (before, now))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    lines = {key: f"{key}: {_text(old, key)} -> {_text(new, key)}" for key in keys}
    last = len(now.get("stage", ())) - 1
    refused = [key for key in keys if not _is_free(key, last)]
    if refused:
        more = f" (and {len(refused) - 5} more)" if len(refused) > 5 else ""
        raise InputError(
            f"{path}: belongs to a different case than {source}: {'; '.join(lines[key] for key in refused[:5])}{more}. "
            f"A restart continues with the same model and time step, and may change {', '.join(FREE)} only: restore "
            "the case, or start without --restart"
        )
    return list(lines.values())


def _is_free(key: str, last: int) -> bool:
    """Whether a restart may change a key; of stages, the end of the ``last`` alone."""
    found = _OF_STAGES.match(key)
    if found is not None:
        key = found[2]
        if key.endswith(".end") and int(found[1]) != last:
            return False
    return any(key == free or key.startswith(free + ".") for free in FREE)


def check_version(path: Path, attributes: Mapping[str, Any]) -> None:
    """Refuse a checkpoint with another version of the state.

    Raises
    ------
    InputError
    """
    version = attributes.get("state_version")
    if version != STATE_VERSION:
        raise InputError(
            f"{path}: holds version {version} of a run's state, this program reads {STATE_VERSION}: restart with the "
            f"version of pfem_petsc that wrote it ({attributes.get('pfem_petsc', 'unknown')}), or start without "
            "--restart"
        )


def check_mesh_is_the_same(path: Path, mark: int, attributes: Mapping[str, Any], source: str) -> None:
    """Refuse a checkpoint of a mesh with other nodes or bars (the content of a mesh file may have changed).

    Raises
    ------
    InputError
    """
    if attributes.get("mesh_mark") != mark:
        raise InputError(
            f"{path}: the mesh of {source} is not the one that it was written with (other nodes or bars): restore "
            "the mesh, or start without --restart"
        )


def mesh_mark(model: Model, node_order: NaturalOrder, bar_order: NaturalOrder, counted: np.ndarray) -> int:
    """Return a checksum of coordinates and bar ends, the same on any number of ranks. Collective."""
    mesh = model.mesh
    points = node_order.to_slab(mesh.points[: mesh.n_owned])
    ends = bar_order.to_slab(mesh.node_ids[mesh.bars[counted]].astype(np.int64, copy=False).reshape(-1, 2))
    comm: MPI.Comm = model.comm
    return checksum(comm, points, node_order.first) ^ checksum(comm, ends, bar_order.first)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables and lists of tables: {"wall[0].point": ...}."""
    found: dict[str, Any] = {}
    if isinstance(value, Mapping):
        for key, item in value.items():
            found |= _flat(item, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(value, list | tuple) and value and all(isinstance(item, Mapping) for item in value):
        for index, item in enumerate(value):
            found |= _flat(item, f"{prefix}[{index}]")
    else:
        found[prefix] = list(value) if isinstance(value, tuple) else value
    return found


def _text(values: Mapping[str, Any], key: str) -> str:
    if key not in values:
        return "absent"
    text = value_text(values[key])
    return text if len(text) <= 60 else text[:56] + " ..."
