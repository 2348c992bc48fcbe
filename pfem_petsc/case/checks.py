"""Checks of a case across its tables: all names that are used exist, and names are unique."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..fields import cell_fields, point_fields
from ..registry import nearest
from .materials import internal_variables, law_name, law_of
from .problems import Problems

__all__ = ["check_names"]


def check_names(case: Mapping[str, Any], data: Mapping[str, Any], problems: Problems) -> None:
    """Report all unknown and duplicate names.

    Parameters
    ----------
    case : the validated tables by name, without rejected ones
    data : the case as read; names whose table was rejected are not reported again
    problems : receives the problems
    """
    materials, sections, node_sets = (_names(data, key) for key in ("material", "section", "node_set"))
    for key, names in (("material", materials), ("section", sections)):
        if not names and isinstance(data.get(key, {}), Mapping):
            problems.add((), f"no [{key}.NAME] is given: a case needs at least one {key}")
    for name, section in case["section"].items():
        problems.refer(("section", name, "material"), section.material, materials, "material")
    default = [name for name, section in case["section"].items() if section.bars is None]
    if len(default) > 1:
        problems.add(
            ("section", default[1]), f"both this section and {default[0]} name no bars; only one can be the default"
        )
    _unique("section", [(name, s.bars) for name, s in case["section"].items()], problems)

    _between(case, node_sets, problems)
    on = [entry for entry in case["initial"] if entry.node_set is not None]
    for key in ("support", "mass", "spring", "dashpot", "load", "wall"):
        for i, entry in enumerate(case[key]):
            _node_set((key, i), entry, node_sets, problems)
    for i, entry in enumerate(on):
        _node_set(("initial", "on", i), entry, node_sets, problems)
    _distinct(("wall",), case["wall"], "wall", problems)
    _ruptures(case, problems)
    _removals(case, problems)
    for table, what in (("contact_pair", "contact pair"), ("constraint", "constraint")):
        for i, entry in enumerate(case[table]):
            _node_sets((table, i), entry, node_sets, problems)
        _distinct((table,), case[table], what, problems)

    _node_sets(("static",), getattr(case["static"], "parameters", None), node_sets, problems)
    output = case["output"]
    if output is not None:
        for i, probe in enumerate(output.probe):
            _node_set(("output", "probe", i), probe, node_sets, problems)
        _distinct(("output", "probe"), output.probe, "probe", problems)
        known = list(dict.fromkeys([*point_fields(), *cell_fields(), *internal_variables(case["material"])]))
        for i, name in enumerate(output.fields or ()):
            if name not in known:
                problems.add(("output", "fields", i), f"there is no field of this name{nearest(name, known)}", name)
            elif name in output.fields[:i]:
                problems.add(("output", "fields", i), "this field is listed twice", name)


def _between(case: Mapping[str, Any], node_sets: list[str], problems: Problems) -> None:
    """Check the names of node sets that springs and dashpots connect."""
    for key in ("spring", "dashpot"):
        for i, entry in enumerate(case[key]):
            for name in entry.between or ():
                problems.refer((key, i, "between"), name, node_sets, "node set")


def _ruptures(case: Mapping[str, Any], problems: Problems) -> None:
    """Check that laws have the variables that limits of rupture compare."""
    for name, material in case["material"].items():
        variables = [variable for variable, _ in law_of(material).internal]
        for limit in ("plastic_strain", "damage"):
            value = getattr(material.rupture, limit, None)
            if value is not None and not any(variable.endswith(limit) for variable in variables):
                law = law_name(dict(material))
                message = f"the law {law} has no {limit.replace('_', ' ')}; use another limit or law"
                problems.add(("material", name, "rupture", limit), message, value)


def _removals(case: Mapping[str, Any], problems: Problems) -> None:
    """Check that supports have distinct names, and that removals refer to them."""
    named = [entry.name for entry in case["support"]]
    for i, name in enumerate(named):
        if name is not None and name in named[:i]:
            problems.add(("support", i, "name"), "another support has this name", name)
    supports = [name for name in named if name is not None]
    for i, entry in enumerate(case["remove"]):
        if entry.supports is not None:
            problems.refer(("remove", i, "supports"), entry.supports, supports, "support")
        target = (entry.bars, entry.supports)
        if target in [(other.bars, other.supports) for other in case["remove"][:i]]:
            problems.add(("remove", i), f"{entry.bars or entry.supports!r} is removed by an earlier table already")


def _names(data: Mapping[str, Any], key: str) -> list[str]:
    table = data.get(key, {})
    return [str(name) for name in table] if isinstance(table, Mapping) else []


def _node_set(path: tuple[str | int, ...], entry: Any, known: list[str], problems: Problems) -> None:
    if entry.node_set is not None:
        problems.refer((*path, "node_set"), entry.node_set, known, "node set")


def _node_sets(path: tuple[str | int, ...], entry: Any, known: list[str], problems: Problems) -> None:
    """Names of node sets in the keys of type ``NodeSetName``; None has none."""
    for key, field in getattr(type(entry), "model_fields", {}).items():
        if (field.json_schema_extra or {}).get("refers_to") == "node_set" and getattr(entry, key) is not None:
            problems.refer((*path, key), getattr(entry, key), known, "node set")


def _distinct(path: tuple[str | int, ...], entries: Any, what: str, problems: Problems) -> None:
    names = [entry.name for entry in entries]
    for i, name in enumerate(names):
        if name in names[:i]:
            problems.add((*path, i, "name"), f"another {what} has this name", name)


def _unique(key: str, named_bars: list[tuple[str, str | None]], problems: Problems) -> None:
    """Check that each bar group belongs to one section only."""
    seen: dict[str, str] = {}
    for name, bars in named_bars:
        if bars is not None and bars in seen:
            problems.add((key, name, "bars"), f"section {seen[bars]} has these bars already", bars)
        elif bars is not None:
            seen[bars] = name
