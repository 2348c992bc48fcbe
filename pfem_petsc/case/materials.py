"""The materials of a case, each with the keys of its law, a module of ``pfem_petsc.mechanics.materials``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import InputError
from ..registry import choices, lookup
from .base import StrictModel
from .problems import Problems

__all__ = ["LAWS", "internal_variables", "law_name", "law_of", "read_materials"]

LAWS = "pfem_petsc.mechanics.materials"

_HARDENING = ("isotropic_hardening", "kinematic_hardening")


def law_name(keys: Mapping[str, Any]) -> Any:
    """Return the law of a table; without the key ``law`` it depends on whether there is a ``yield_stress``."""
    if keys.get("law") is not None:
        return keys["law"]
    return "elastic" if keys.get("yield_stress") is None else "elastoplastic"


def law_of(material: StrictModel) -> Any:
    """Return the :class:`~pfem_petsc.mechanics.materials.base.Law` of a material of a case."""
    return material.choose(lookup(LAWS, law_name(dict(material)), "material.law").LAW)


def internal_variables(materials: Mapping[str, StrictModel]) -> dict[str, str]:
    """Return name and unit of all internal variables of a case's laws, in the order of the case."""
    return {name: unit for material in materials.values() for name, unit in law_of(material).internal}


def read_materials(data: Mapping[str, Any], problems: Problems) -> dict[str, StrictModel]:
    """Read the tables [material.NAME] in file order; rejected ones are reported in ``problems`` and left out."""
    tables = data.get("material", {})
    if not isinstance(tables, Mapping):
        problems.add(("material",), "expected tables, each under a heading [material.NAME]", tables)
        return {}
    read = {str(name): _read(table, str(name), problems) for name, table in tables.items()}
    return {name: material for name, material in read.items() if material is not None}


def _read(table: Any, name: str, problems: Problems) -> StrictModel | None:
    path = ("material", name)
    if not isinstance(table, Mapping):
        problems.add(path, "expected a table", table)
        return None
    law, hardening = law_name(table), []
    if table.get("law") is None and law == "elastic":
        # resolved cases of earlier versions have zeros for materials that cannot yield
        table = {key: value for key, value in table.items() if not (key in _HARDENING and value == 0.0)}
        hardening = [key for key in _HARDENING if key in table]
        if hardening:
            # the other keys are validated nevertheless
            law, table = "elastoplastic", {**table, "yield_stress": 1.0}
    try:
        module = lookup(LAWS, law, "")
    except InputError as error:
        problems.add(
            (*path, "law"), str(error).partition(": ")[2].replace(f"unknown value {law!r}", "unknown value"), law
        )
        return None
    material = problems.read(module.Parameters, table, path, taker=f"the law {law}", siblings=_siblings)
    if material is not None and hardening:
        problems.add(path, f"{hardening[0]} = {table[hardening[0]]!r} needs a yield_stress [Pa]")
        return None
    if material is not None and material.softening is not None and module.LAW.softening is None:
        problems.add((*path, "softening"), f"the law {law} does not soften by a table; remove the key")
        return None
    return material


def _siblings() -> dict[str, list[str]]:
    """Return all laws with their keys."""
    return {name: list(lookup(LAWS, name, "").Parameters.model_fields) for name in choices(LAWS)}
