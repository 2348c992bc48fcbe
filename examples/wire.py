"""Wire files, text of our own: the lines ``node X Y Z``, ``bar I J`` from 1, and ``group NAME`` before its bars."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from pfem_petsc.errors import InputError
from pfem_petsc.mesh.whole import WholeMesh

SUFFIXES = (".wire",)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh of a wire file, whose lengths are in metres and which has no fields."""
    points, bars, groups = [], [], {}
    name = ""
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        word, *rest = line.partition("#")[0].split() or [""]
        try:
            if word == "node":
                x, y, z = map(float, rest)
                points.append((x, y, z))
            elif word == "bar":
                first, second = map(int, rest)
                groups.setdefault(name, []).append(len(bars))
                bars.append((first - 1, second - 1))
            elif word == "group":
                (name,) = rest
            elif word:
                raise ValueError
        except ValueError:
            raise InputError(
                f"{path}: line {number}: {line[:60]!r}: expected node X Y Z, bar I J or group NAME"
            ) from None
    mesh = WholeMesh(np.array(points).reshape(-1, 3), np.array(bars, np.int64).reshape(-1, 2))
    mesh.bar_groups = {name: np.array(members) for name, members in groups.items() if name}
    return mesh
