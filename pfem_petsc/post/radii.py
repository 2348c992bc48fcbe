"""Radii of the bars of a result, from the sections of its case and the areas of its mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InputError
from ..mechanics.bars import area_fields, bar_shapes, named_groups, section_of_bars
from ..mesh import load_slab

__all__ = ["STOUT", "drawn_radii", "radii_of"]

STOUT = 0.2
"""Largest radius of a drawn bar as a fraction of its length; nodes of stouter ones would hide their bars."""


def drawn_radii(result: Any, note: Callable[[str], None] | None = None) -> np.ndarray | None:
    """Return the radius of each bar (bars,) [m] as it is drawn, None where it is not known; ``note`` receives a remark
    on bars that are drawn thinner than they are."""
    radius = radii_of(result)
    if radius is None:
        return None
    most = STOUT * _lengths(result)
    stout = int(np.count_nonzero(radius > most))
    if stout and note is not None:
        note(
            f"{stout} of {len(radius)} bars have a radius above {STOUT:g} of their length "
            f"({radius.max():.3g} m at most), and are drawn with that; --radius-scale changes it"
        )
    return np.minimum(radius, most)


def radii_of(result: Any) -> np.ndarray | None:
    """Return the outer radius of each bar (bars,) [m], None where it is not known.

    The mesh is made or read again, for the sections of bars and the fields of areas. Where it is not there any more,
    all bars have the radius of the only section; with several sections, radii are not known. Springs and dashpots
    between nodes have no section: they are as thin as the thinnest bar.
    """
    case = result.case
    sections = list(getattr(case, "section", {}).values())
    if not sections:
        return None
    length = _lengths(result)
    try:
        numbers, areas = _sections_and_areas(case, len(length))
    except (InputError, OSError):
        if len(sections) > 1 or sections[0].area is None:
            return None
        numbers, areas = np.zeros(len(length), dtype=int), np.full(len(length), sections[0].area)
    radius = np.full(len(length), np.inf)
    for number, section in enumerate(sections):
        own = numbers == number
        radius[own] = bar_shapes(section, length[own], areas[own]).radius
    return np.where(np.isfinite(radius), radius, radius.min())


def _lengths(result: Any) -> np.ndarray:
    """Return the length of each bar (bars,) in the first snapshot [m]."""
    start, bars = np.asarray(result.positions(0), dtype=float), np.asarray(result.bars)
    return np.linalg.norm(start[bars[:, 1]] - start[bars[:, 0]], axis=1)


def _sections_and_areas(case: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the section of each bar (count,), -1 for none, and its area [m2]."""
    from mpi4py import MPI

    slab = load_slab(case.mesh, MPI.COMM_SELF, area_fields(case), named_groups(case))
    if slab.n_bars > count:
        raise InputError(f"the mesh of {case.source} has {slab.n_bars} bars now, the result {count}")
    numbers, areas = np.full(count, -1), np.ones(count)
    numbers[: slab.n_bars] = section_of_bars(case, slab)
    for number, section in enumerate(case.section.values()):
        own = np.flatnonzero(numbers == number)
        areas[own] = section.area if section.area_field is None else slab.bar_fields[section.area_field][own]
    return numbers, areas
