"""Materials and sections of Abaqus input files as tables of a case."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ._inp_blocks import Block

__all__ = ["MATERIAL_KEYWORDS", "Materials", "section_of"]

MATERIAL_KEYWORDS = ("ELASTIC", "DENSITY", "PLASTIC", "EXPANSION", "DAMPING")


class Materials:
    """Materials as they are read; :meth:`tables` gives those of a case."""

    def __init__(self) -> None:
        self._found: dict[str, dict[str, Any]] = {}
        self._names: dict[str, str] = {}
        self._current: dict[str, Any] = {}
        self.warnings: list[str] = []

    def _begin(self, block: Block) -> None:
        name = block.required("NAME")
        self._names.setdefault(name.upper(), name)
        self._current = self._found.setdefault(name.upper(), {})

    def name_of(self, name: str) -> str:
        """Return the name of a material as it is defined."""
        return self._names.get(name.upper(), name)

    def add(self, block: Block) -> None:
        """Read ``*MATERIAL``, and what belongs to a material."""
        if block.keyword == "MATERIAL":
            self._begin(block)
            return
        if block.keyword == "DAMPING":
            for name, key in (("ALPHA", "alpha"), ("BETA", "stiffness_damping")):
                if block.get(name):
                    self._current[key] = self._value(block, block.get(name))
            return
        if block.get("TYPE", "ISOTROPIC").upper() not in ("ISOTROPIC", "ISO"):
            self._leave_out(block, f"TYPE={block.get('TYPE')}")
            return
        widths = {"ELASTIC": (3, 1), "DENSITY": (2, 1), "EXPANSION": (2, 1), "PLASTIC": (3, 1)}
        width, least = widths[block.keyword]
        rows = block.rows(8, least)
        if len(rows) == 0 or not np.isfinite(rows[0, 0]):
            self._leave_out(block, "no values")
        elif block.keyword == "PLASTIC":
            self._plastic(block, rows[:, :3])
        else:
            if len(rows) > 1:
                where = f"{block.where}: values at {rows[0, width - 1]:g} degrees"
                self.warnings.append(f"{where} are taken for all temperatures")
            key = {"ELASTIC": "young_modulus", "DENSITY": "density", "EXPANSION": "thermal_expansion"}[block.keyword]
            self._current[key] = float(rows[0, 0])

    def _plastic(self, block: Block, rows: np.ndarray) -> None:
        hardening = block.get("HARDENING", "ISOTROPIC").upper()
        cold = np.isnan(rows[:, 2]) | (rows[:, 2] == rows[0, 2])
        if not cold.all():
            self.warnings.append(f"{block.where}: values at {rows[0, 2]:g} degrees are taken for all temperatures")
        rows = np.where(np.isnan(rows[cold]), 0.0, rows[cold])
        stress, strain = rows[:, 0], rows[:, 1]
        known = hardening == "ISOTROPIC" or (hardening == "KINEMATIC" and len(rows) <= 2)
        if not known or "RATE" in block.parameters:
            self._leave_out(block, f"HARDENING={hardening}" if not known else "RATE")
        elif strain[0] != 0.0 or stress[0] <= 0.0 or (np.diff(strain) <= 0.0).any() or (np.diff(stress) < 0.0).any():
            self._leave_out(block, "a curve that does not start at plastic strain 0, or that falls")
        else:
            self._current["plastic"] = hardening, rows[:, :2]

    def _leave_out(self, block: Block, what: str) -> None:
        self.warnings.append(f"{block.where}: {what}: left out")

    def _value(self, block: Block, text: str) -> float:
        try:
            return float(text.upper().replace("D", "E"))
        except ValueError:
            self._leave_out(block, f"{text!r} is not a number")
            return 0.0

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the materials with the keys of a case, as far as the file has them."""
        return {self._names[name]: _keys(values) for name, values in self._found.items()}


def _keys(values: dict[str, Any]) -> dict[str, Any]:
    """A material's keys; rows of stress over plastic strain are a curve over strain, constant after the last row."""
    keys = {key: values[key] for key in ("young_modulus", "density", "thermal_expansion") if key in values}
    if values.get("alpha") and "density" in values:
        keys["damping"] = values["alpha"] * values["density"]
    if values.get("stiffness_damping"):
        keys["stiffness_damping"] = values["stiffness_damping"]
    if "plastic" not in values:
        return keys
    hardening, rows = values["plastic"]
    if len(rows) == 1:
        keys["yield_stress"] = float(rows[0, 0])
    elif hardening == "KINEMATIC":
        slope = (rows[1, 0] - rows[0, 0]) / rows[1, 1]
        keys |= {"yield_stress": float(rows[0, 0]), "kinematic_hardening": float(slope)}
    elif "young_modulus" in keys:
        strain = rows[:, 0] / keys["young_modulus"] + rows[:, 1]
        keys |= {"law": "multilinear", "curve": np.stack([strain, rows[:, 0]], axis=1).tolist()}
    return keys


def section_of(block: Block) -> dict[str, Any]:
    """Return ``area``, and ``shape`` and ``thickness`` of round bars and tubes, as far as a section tells them."""
    rows = block.rows(16, 1)
    values = rows[0] if len(rows) else np.full(16, np.nan)
    first = float(values[0])
    if block.keyword == "SOLID SECTION":
        return {"area": first if np.isfinite(first) else 1.0}
    kind = block.get("SECTION", "GENERAL" if block.keyword == "BEAM GENERAL SECTION" else "").upper()
    a, b = float(values[0]), float(values[1])
    found: dict[str, Any] = {}
    if kind == "GENERAL":
        found = {"area": first}
    elif kind == "CIRC":
        found = {"area": math.pi * a * a, "shape": "round"}
    elif kind == "PIPE":
        found = {"area": math.pi * (2.0 * a - b) * b, "shape": "tube", "thickness": b}
    elif kind == "RECT":
        found = {"area": a * b}
    elif kind == "BOX":
        left, top, right, bottom = (float(value) for value in values[2:6])
        found = {"area": a * b - (a - left - right) * (b - top - bottom)}
    return found if np.isfinite(found.get("area", np.nan)) else {}
