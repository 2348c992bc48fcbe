"""Mechanisms of lattices as pin-jointed trusses, from their unit cell."""

from __future__ import annotations

import itertools

import numpy as np

from .cell import UnitCell

__all__ = ["mechanism_warning", "periodic_mechanisms"]

_ZERO = 1e-8
_LARGEST = 100
"""Points of a cell up to which the matrices are so small that every run can afford them."""


def periodic_mechanisms(cell: UnitCell) -> tuple[int, int]:
    """Count motions of the infinite lattice that stretch no bar.

    Returns
    -------
    uniform : those that strain the lattice as a whole, or repeat in every cell, besides translations
    waves : those that alternate from cell to cell along one, two or three axes

    Notes
    -----
    Displacements u exp(i k . R) + E R of the points of cell R, with a symmetric strain E for k = 0 alone (R. G.
    Hutchinson and N. A. Fleck, "The structural performance of the periodic truss", J. Mech. Phys. Solids 54, 2006): the
    null space of the elongations of the struts of one cell.
    """
    count = len(cell.points)
    vectors = cell.vectors()
    directions = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    strains = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
    uniform = waves = 0
    for wave in itertools.product((0, 1), repeat=3):
        rows = np.zeros((len(cell.ends), 3 * count + 6))
        for which, sign in ((0, -1.0), (1, 1.0)):
            phase = sign * (-1.0) ** (cell.offsets[:, which] @ np.array(wave))
            for axis in range(3):
                np.add.at(
                    rows,
                    (np.arange(len(rows)), 3 * cell.ends[:, which] + axis),
                    phase * directions[:, axis],
                )
        if not any(wave):
            rows[:, 3 * count :] = vectors[:, strains[:, 0]] * directions[:, strains[:, 1]]
            uniform = rows.shape[1] - np.linalg.matrix_rank(rows, tol=_ZERO) - 3
        else:
            rows = rows[:, : 3 * count]
            waves += rows.shape[1] - np.linalg.matrix_rank(rows, tol=_ZERO)
    return int(uniform), int(waves)


def mechanism_warning(kind: str, cell: UnitCell) -> list[str]:
    """Return a warning if the lattice is a mechanism as a pin-jointed truss."""
    if len(cell.points) > _LARGEST:
        return []
    uniform, waves = periodic_mechanisms(cell)
    if uniform + waves == 0:
        return []
    what = []
    if uniform:
        what.append(f"{uniform} that repeat{'s' * (uniform == 1)} in every cell")
    if waves:
        what.append(f"{waves} that alternate{'s' * (waves == 1)} from cell to cell")
    return [
        f"mesh.kind = {kind!r} is a mechanism: motions of the infinite lattice stretch no bar ({' and '.join(what)}); "
        "bars are pin-jointed here, and nothing resists these motions to first order: add struts, or supports"
    ]
