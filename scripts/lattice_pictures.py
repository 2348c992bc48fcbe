"""Draws the pictures of docs/lattices.md: all kinds with their bar groups, and what is made of blocks.

    .venv/bin/python scripts/lattice_pictures.py

Each lattice is a result of one short step, drawn by ``render``; each group of struts has a prestress that colours it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from pfem_petsc import Case, Simulation
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.post.render import render

ROOT = Path(__file__).resolve().parent.parent
BRACKET = ROOT / "pfem_petsc" / "cases" / "bracket.stl"
SIZE = (1000, 800)
CROP = (slice(55, 757), slice(75, 885))
"""Rows and columns of a frame without title and legend."""

DENSE = {"cubic": (1, 1, 1), "octet": (1, 1, 1), "bcc": (1, 1, 1), "tetrahedral_octahedral": (2, 1, 3)}
KINDS: dict[str, dict[str, Any]] = {
    kind: {"kind": kind, "cells": DENSE.get(kind, (2, 2, 2)), "pitch": 0.01}
    for kind in (
        *("cubic", "octet", "bcc", "bcc_diagonals", "fcc", "kelvin", "diamond", "gyroid", "auxetic"),
        "tetrahedral_octahedral",
    )
}
SHAPES: dict[str, dict[str, Any]] = {
    'grading = [1, 1, "1 + 20*z"]': {
        "kind": "bcc",
        "cells": (3, 3, 5),
        "pitch": 0.01,
        "grading": [1, 1, "1 + 20*z"],
    },
    "perturbation = 0.12, missing = 0.2": {
        "kind": "octet",
        "cells": (3, 3, 3),
        "pitch": 0.01,
        "perturbation": 0.12,
        "missing": 0.2,
    },
    "curved: cylinder, closed": {
        "kind": "cubic",
        "cells": (24, 8, 1),
        "pitch": 0.01,
        "curved": {"shape": "cylinder", "radius": 0.04, "closed": True},
    },
    "curved: sphere": {
        "kind": "octet",
        "cells": (10, 10, 1),
        "pitch": 0.01,
        "curved": {"shape": "sphere", "radius": 0.06},
    },
    'surface: bracket.stl, cut = "trim"': {
        "kind": "octet",
        "pitch": 0.008,
        "surface": {"file": str(BRACKET), "scale": 0.001, "cut": "trim"},
    },
    'surface: bracket.stl, cut = "clip"': {
        "kind": "octet",
        "pitch": 0.008,
        "surface": {"file": str(BRACKET), "scale": 0.001, "cut": "clip"},
    },
}


def picture(keys: dict[str, Any], folder: Path) -> Any:
    """Return the picture of a lattice as an array (rows, columns, colours)."""
    groups = list(lattice.Parameters(**keys).unit_cell().groups)
    groups += ["skin"] * (keys["kind"] == "tetrahedral_octahedral")
    area = 2e-4 * keys["pitch"] ** 2
    stresses = [0.0] if len(groups) == 1 else [1e3, -1e3, 0.0]
    case = {
        "title": " ",
        "mesh": {"generator": "lattice", **keys},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {
            name: {"area": area, "material": "m", "bars": name, "prestress": stress}
            for name, stress in zip(groups, stresses)
        },
        "time": {"integrator": "central_differences", "step": 1e-9, "end": 1e-9},
    }
    with Simulation(Case.from_dict(case), output=folder, quiet=True) as simulation:
        simulation.run()
    (path,) = render(folder, folder / "pictures", frames=[0], size=SIZE, view="iso", video="none", poster=False)
    return plt.imread(path)[CROP]


def sheet(lattices: dict[str, dict[str, Any]], columns: int, path: Path) -> None:
    """Draw lattices with their names on one page."""
    rows = -(-len(lattices) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.2 * columns, 3.3 * rows), layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        for number, ((name, keys), axis) in enumerate(zip(lattices.items(), axes.flat)):
            axis.imshow(picture(keys, Path(folder, str(number))))
            axis.set_title(name, fontsize=14 if columns > 3 else 12)
            axis.axis("off")
    figure.savefig(path, dpi=100)
    print(path)


if __name__ == "__main__":
    sheet(KINDS, 5, ROOT / "docs" / "images" / "lattice_kinds.png")
    sheet(SHAPES, 3, ROOT / "docs" / "images" / "lattice_shapes.png")
