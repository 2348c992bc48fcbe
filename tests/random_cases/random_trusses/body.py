"""The truss of a random case: mesh, materials and sections, and an estimate of its highest frequency."""

from __future__ import annotations

import importlib
import random
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from pfem_petsc.mesh.slab import MeshSlab

CELLS = ((1, 1, 1), (2, 1, 1), (1, 2, 1), (1, 1, 2), (2, 2, 1), (2, 1, 2), (1, 2, 2), (3, 1, 1))
PLAIN_KINDS = ("cubic", "octet", "bcc")
OPEN_KINDS = ("fcc", "bcc_diagonals", "kelvin", "diamond", "gyroid", "auxetic", "tetrahedral_octahedral")


@dataclass
class Body:
    """A truss at rest.

    Attributes
    ----------
    tables : the tables mesh, material, section and, where bars are heated, temperature
    points : (nodes, 3) [m]
    bars : (bars, 2)
    groups : node groups of the mesh
    limit : estimate of the stable step of central differences with lumped mass [s]
    wave : speed of waves in the fastest material [m/s]
    length : of the shortest bar [m]
    size : largest extent [m]
    mass : of the truss [kg]
    stiffness : largest young_modulus times area [N]
    """

    tables: dict[str, Any]
    points: np.ndarray
    bars: np.ndarray
    groups: dict[str, np.ndarray]
    limit: float = 0.0
    wave: float = 0.0
    length: float = 0.0
    size: float = 0.0
    mass: float = 0.0
    stiffness: float = 0.0
    bar_groups: dict[str, np.ndarray] = field(default_factory=dict)


def draw_body(chance: random.Random) -> Body:
    """A mesh of a generator with materials and sections."""
    table = _mesh(chance)
    plain = dict(table)
    if table["generator"] == "lattice":
        table |= _varied(table)
    slab = generated(table)
    groups = {name: members for name, members in slab.node_groups.items() if len(members)}
    body = Body({"mesh": table}, slab.points, np.asarray(slab.bars), groups)
    if table["generator"] != "lattice" or table != plain:
        body.bar_groups = {name: members for name, members in slab.bar_groups.items() if len(members)}
    vectors = body.points[body.bars[:, 1]] - body.points[body.bars[:, 0]]
    lengths = np.linalg.norm(vectors, axis=1)
    body.length = float(lengths.min())
    body.size = float(np.ptp(body.points, axis=0).max())
    materials = {"m0": _material(chance, body.size)}
    sections: dict[str, Any] = {"s0": {"area": 10 ** chance.uniform(-4, -2), "material": "m0"}}
    stiffness = np.full(len(lengths), materials["m0"]["young_modulus"] * sections["s0"]["area"])
    weight = np.full(len(lengths), materials["m0"]["density"] * sections["s0"]["area"])
    if len(body.bar_groups) > 1 and chance.random() < 0.4:
        group = chance.choice(sorted(body.bar_groups))
        name = "m0"
        if chance.random() < 0.5:
            name, materials["m1"] = "m1", _material(chance, body.size)
        sections["s1"] = {"area": 10 ** chance.uniform(-4, -2), "material": name, "bars": group}
        members = body.bar_groups[group]
        stiffness[members] = materials[name]["young_modulus"] * sections["s1"]["area"]
        weight[members] = materials[name]["density"] * sections["s1"]["area"]
    body.tables |= {"material": materials, "section": sections}
    body.wave = float(np.sqrt((stiffness / weight).max()))
    body.mass = float((weight * lengths).sum())
    body.stiffness = float(stiffness.max())
    body.limit = _limit(body, vectors, lengths, stiffness, weight)
    if chance.random() < 0.15:
        body.tables["temperature"] = [_temperature(chance, body)]
    return body


def _mesh(chance: random.Random) -> dict[str, Any]:
    kind = chance.choices(("rod", "two_rods", "ring", "lattice"), (25, 18, 22, 35))[0]
    if kind == "rod":
        return {"generator": "rod", "length": chance.uniform(0.5, 2.0), "elements": chance.randint(1, 20)}
    if kind == "two_rods":
        length = chance.uniform(0.5, 1.5)
        gap = length * 10 ** chance.uniform(-3, -1.3)
        return {"generator": kind, "length": length, "elements": chance.randint(1, 9), "gap": gap}
    if kind == "ring":
        outer = chance.uniform(0.5, 2.0)
        return {
            "generator": "ring",
            "outer_radius": outer,
            "inner_radius": outer * chance.uniform(0.6, 0.9),
            "bays": chance.randint(3, 10),
            "bracing": chance.choice(("x", "single")),
            "orientation": chance.choice(("vertex", "flat")),
        }
    cells, shape = chance.choice(CELLS), chance.choice(PLAIN_KINDS)
    return {"generator": "lattice", "kind": shape, "cells": cells, "pitch": chance.uniform(0.1, 0.5)}


def generated(table: dict[str, Any]) -> MeshSlab:
    """Return the whole mesh of a table ``[mesh]``."""
    module = importlib.import_module(f"pfem_petsc.mesh.generators.{table['generator']}")
    keys = module.Parameters(**{key: value for key, value in table.items() if key != "generator"})
    if hasattr(module, "generate_on"):
        return module.generate_on(keys, MPI.COMM_SELF, {}, None)
    return module.generate(keys, 0, 1)


def _varied(table: dict[str, Any]) -> dict[str, Any]:
    """Return other keys of a quarter of the lattices, by a chance of their own: other cases stay as they were."""
    chance = random.Random(repr(table))
    if chance.random() < 0.75:
        return {}
    keys: dict[str, Any] = {}
    if chance.random() < 0.7:
        keys["kind"] = chance.choice(OPEN_KINDS)
    if chance.random() < 0.4:
        keys["perturbation"] = chance.uniform(0.005, 0.04)
    if chance.random() < 0.3:
        keys |= {"missing": chance.uniform(0.02, 0.15), "dangling": "keep"}
    if chance.random() < 0.3:
        factor = chance.uniform(0.5, 2.0)
        keys["grading"] = chance.choice(([1, 1, factor], [1, f"1 + {factor:.3g}*y", 1]))
    elif chance.random() < 0.2:
        keys["curved"] = {"shape": chance.choice(("cylinder", "sphere")), "radius": chance.uniform(3.0, 5.0)}
    return keys


def _material(chance: random.Random, size: float) -> dict[str, Any]:
    young, density = 10 ** chance.uniform(5, 8), 10 ** chance.uniform(2.5, 4)
    table: dict[str, Any] = {"young_modulus": young, "density": density}
    table["strain"] = chance.choices(("engineering", "green", "logarithmic"), (2, 1, 1))[0]
    if chance.random() < 0.3:
        table["yield_stress"] = young * 10 ** chance.uniform(-3, -1.7)
        hardening = chance.choice(((1,), (0,), (1, 0), (0, 1), (1, 0)))
        for key, used in zip(("isotropic_hardening", "kinematic_hardening"), (*hardening, 1), strict=False):
            if used:
                table[key] = young * 10 ** chance.uniform(-2, -0.3)
    if chance.random() < 0.25:
        table["damping"] = density * np.sqrt(young / density) / size * 10 ** chance.uniform(-2, 0)
    if chance.random() < 0.4:
        table["thermal_expansion"] = chance.choice((1, 1, -1)) * 10 ** chance.uniform(-6, -4)
    return {key: value if isinstance(value, str) else float(value) for key, value in table.items()}


def _limit(body: Body, vectors: np.ndarray, lengths: np.ndarray, stiffness: np.ndarray, weight: np.ndarray) -> float:
    """2 / omega of the highest mode with lumped mass, from the dense matrices."""
    n = len(body.points)
    mass, matrix = np.zeros(n), np.zeros((n, 3, n, 3))
    for (i, j), vector, length, ea, w in zip(body.bars, vectors, lengths, stiffness, weight, strict=True):
        block = ea / length**3 * np.outer(vector, vector)
        mass[[i, j]] += 0.5 * w * length
        matrix[i, :, i] += block
        matrix[j, :, j] += block
        matrix[i, :, j] -= block
        matrix[j, :, i] -= block
    root = 1.0 / np.sqrt(np.repeat(mass, 3))
    scaled = matrix.reshape(3 * n, 3 * n) * root[:, None] * root[None, :]
    return float(2.0 / np.sqrt(np.linalg.eigvalsh(scaled)[-1]))


def _temperature(chance: random.Random, body: Body) -> dict[str, Any]:
    table: dict[str, Any] = {}
    if body.bar_groups and chance.random() < 0.5:
        table["bars"] = chance.choice(sorted(body.bar_groups))
    if chance.random() < 0.4:
        return {**table, "value": chance.uniform(-60.0, 60.0)}
    # rows over the duration, which is not known yet: fractions of it
    rows = sorted(chance.random() for _ in range(chance.randint(1, 4)))
    return {**table, "table": [[row, chance.uniform(-60.0, 60.0)] for row in rows]}
