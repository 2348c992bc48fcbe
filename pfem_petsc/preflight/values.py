"""Values out of any engineering range, mostly due to units other than SI. They are reported, never rejected."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..output.units import engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.model import Model

_SLENDER = 1e4
"""Length over thickness of a bar beyond which one of the two is mostly in another unit: a cable of 100 m and 1 cm."""

_STRONGEST = 50.0
"""Acceleration [m/s2] beyond which a record is mostly in another unit: the strongest ground motions reach 40 m/s2."""

_LEAST = 5e-6
"""Strain at which no material yields or breaks: 220 for 220 MPa is 1e-9, in kPa 1e-6; soft metals yield at 1e-4."""

_PRESTRAINS = 1e-6, 0.2
"""Range of strains that prestress gives engineering structures: cables have 1e-4 to 1e-2, those hardly taut 1e-5."""

_STRENGTHS = ("yield_stress", "proof_stress", "tensile_strength")

_HINT = "case files are in SI units (m, kg, s, N, Pa)"


def odd_numbers(case: Case, model: Model) -> list[str]:
    """Return one message for each suspicious value: key, value, reason. Collective."""
    texts = [*_materials(case), *_sections(case), *_mesh(model), *_slender(case, model)]
    texts += [
        f"wall {wall.name!r}: gravity = true, but the case has no [gravity], so none acts on it"
        for wall in case.wall
        if wall.gravity and case.gravity is None
    ]
    texts += [
        f"node_set.{name}.nearest: {text}, more than the size of the truss"
        for name, text in _distant(case, model, model.length)
    ]
    return [f"{case.source}: {text}" for text in texts]


def odd_accelerations(case: Case) -> list[str]:
    """Return one message for each ground acceleration or gravity, of all stages, that is beyond those of the Earth."""
    texts = []
    for k, stage in enumerate(case.stages):
        where = f"stage[{k}]." if case.stage and k > 0 else ""  # tables at the top belong to the first stage
        given = {f"support[{n}]": entry.acceleration for n, entry in enumerate(stage.support)}
        if stage.gravity is not None:
            given["gravity"] = stage.gravity.acceleration
        for table, rows in given.items():
            if rows is None or (k > 0 and stage.holds(table.split("[")[0])):
                continue
            peak = float(np.abs(np.atleast_2d(np.array(rows, dtype=float))[:, -3:]).max(initial=0.0))
            if peak > _STRONGEST:
                texts.append(
                    f"{case.source}: {where}{table}.acceleration reaches {peak:.4g} m/s2, {peak / 9.80665:.3g} g: a "
                    "record in cm/s2 needs scale = 0.01, lengths in mm 0.001"
                )
    return texts


def _materials(case: Case) -> Iterator[str]:
    for name, material in case.material.items():
        key = f"material.{name}"
        speed = math.sqrt(material.young_modulus / material.density)
        if not 0.1 <= material.density <= 3e4:
            yield f"{key}.density = {material.density:g} kg/m3: no solid has that; {_HINT}"
        if not 0.5 <= speed <= 2e4 or (speed < 10.0 and material.density > 100.0):
            yield (
                f"{key}.young_modulus = {material.young_modulus:g} Pa gives a wave speed of "
                f"{engineering(speed, 'm/s')}: that of steel is 5 km/s, of rubber 30 m/s; {_HINT}"
            )
        if material.softening is not None and not case.temperature:
            yield f"{key}.softening: without a [[temperature]] its factors are those of the reference temperature"
        yield from material.suspicions(key, _HINT)
        strengths = {f"{key}.{name}": getattr(material, name, None) for name in _STRENGTHS}
        for name in ("stress", "compressive_stress"):
            strengths[f"{key}.rupture.{name}"] = getattr(material.rupture, name, None)
        for name, stress in strengths.items():
            if stress is not None and stress < _LEAST * material.young_modulus:
                strain = stress / material.young_modulus
                yield f"{name} = {stress:g} Pa is reached at a strain of {strain:.3g}; 220 MPa are 220e6; {_HINT}"


def _sections(case: Case) -> Iterator[str]:
    for name, section in case.section.items():
        if section.area is not None and not 1e-18 <= section.area <= 10.0:
            yield f"section.{name}.area = {section.area:g} m2: no bar has that; 1 mm2 is 1e-6 m2"
        young = case.material[section.material].young_modulus
        stiffness = None if section.area is None else young * section.area
        for key, unit, hard in (("prestress", "Pa", young), ("pretension", "N", stiffness)):
            given = getattr(section, key)
            if given is None or hard is None:
                continue
            value = float(np.abs(np.atleast_2d(np.array(given, dtype=float))[:, -1]).max())
            if value and not _PRESTRAINS[0] <= value / hard <= _PRESTRAINS[1]:
                yield f"section.{name}.{key} reaches {value:g} {unit}, a strain of {value / hard:.3g}; {_HINT}"


def _slender(case: Case, model: Model) -> Iterator[str]:
    """Bars far longer than thick: a mesh in millimetres with areas in square metres."""
    mesh = model.mesh
    worst = np.zeros((len(case.section), 3))  # length over thickness, length, area
    for block, bars in zip(mesh.blocks, model.bars.blocks, strict=True):
        lengths = model.bars.mesh_lengths[block.start : block.counted]
        if len(lengths) and block.section < len(worst):  # others are springs and dashpots
            areas = np.broadcast_to(bars.counted_area, lengths.shape)
            ratios = lengths / np.sqrt(areas)
            k = int(np.lexsort((lengths, ratios))[-1])
            worst[block.section] = ratios[k], lengths[k], areas[k]
    for name, *rows in zip(case.section, *model.comm.allgather(worst.tolist()), strict=True):
        ratio, length, area = max(rows)
        if ratio > _SLENDER and area >= 1e-18:  # smaller areas are reported as such
            yield (
                f"section.{name}: a bar of {engineering(length, 'm')} is {ratio:,.0f} times as long as it "
                f"is thick (area = {area:g} m2): is the mesh in millimetres? {_HINT}"
            )


def far_points(case: Case, model: Model) -> dict[str, str]:
    """Label and text of node sets whose nearest node is far from the point. Collective."""
    longest = model.comm.allreduce(float(model.bars.mesh_lengths.max(initial=0.0)), op=MPI.MAX)
    far = _distant(case, model, longest)
    return {f"node set {name}": f"{text}, more than the length of the longest bar" for name, text in far}


def _distant(case: Case, model: Model, most: float) -> Iterator[tuple[str, str]]:
    """Name and text of node sets whose nearest node is farther from the point than ``most`` [m]."""
    mesh = model.mesh
    for name, node_set in case.node_set.items():
        if node_set.nearest is not None:
            away = np.linalg.norm(mesh.points[: mesh.n_owned] - np.array(node_set.nearest), axis=1)
            distance, node = _extreme(model, -away)
            if -distance > most:
                yield name, f"the nearest node is node {node}, {engineering(-distance, 'm')} away from the point"


def _extreme(model: Model, values: np.ndarray) -> tuple[float, int]:
    """Return the largest of the values (owned,) of nodes, and the lowest mesh number of a node with it. Collective."""
    at = int(values.argmax()) if len(values) else -1
    mine = (-float(values[at]), int(model.mesh.node_ids[at])) if at >= 0 else (np.inf, -1)
    least, node = min(model.comm.allgather(mine))
    return -least, node


def _mesh(model: Model) -> Iterator[str]:
    rest = model.bars.mesh_lengths
    longest = model.comm.allreduce(float(rest.max(initial=0.0)), op=MPI.MAX)
    shortest = model.comm.allreduce(float(rest.min(initial=np.inf)), op=MPI.MIN)
    if longest > 1e5 or shortest < 1e-9:
        yield (
            f"the bars are {engineering(shortest, 'm')} to {engineering(longest, 'm')} long, the truss "
            f"{engineering(model.length, 'm')}; {_HINT}"
        )
    if model.reach > 1e6 * max(model.length, np.finfo(float).tiny):
        yield (
            f"the truss is {engineering(model.length, 'm')} in size and {engineering(model.reach, 'm')} away from the "
            "origin: strains lose accuracy by this ratio; move it to the origin"
        )
    with np.errstate(over="ignore"):  # reported below
        fastest, node = _extreme(model, np.linalg.norm(model.initial_velocity(), axis=1))
    if fastest > model.wave_speed:
        yield (
            f"node {node} starts at {engineering(fastest, 'm/s')}, faster than waves in the bars "
            f"({engineering(model.wave_speed, 'm/s')}): an impact at that speed crushes bars to zero length"
        )
