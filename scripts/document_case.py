"""All keys of a case file, with type, unit, default and meaning, from the models that validate it.

    python scripts/document_case.py            # prints the page docs/reference/case_keys.md of the site

``scripts/docs.sh`` writes the page anew at each build. A key is documented by the text below it in its class.
"""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic.fields import FieldInfo

from pfem_petsc.case.base import StrictModel
from pfem_petsc.case.files import TableFile
from pfem_petsc.case.model import KEYS, STAGE_TABLES, CaseModel, Family, StageName, StageOutput, shape_of
from pfem_petsc.case.tables import Damping
from pfem_petsc.registry import choices, lookup


def _tables() -> dict[str, tuple[type[StrictModel] | Family, ...]]:
    """The tables of a case file by heading, with the models that have their keys."""
    found: dict[str, tuple[type[StrictModel] | Family, ...]] = {}
    for key, field in CaseModel.model_fields.items():
        shape = shape_of(field)
        heading = {list: f"[[{key}]]", dict: f"[{key}.NAME]"}.get(shape.many, f"[{key}]")
        found[heading] = shape.models if shape.family is None else (*shape.models, shape.family)
    found |= {"[[stage]]": (StageName, StageOutput), "[damping]": (Damping,)}
    return {**{heading: models for heading, models in found.items() if models}, "Columns of files": (TableFile,)}


TABLES = _tables()
"""The tables of a case file in the order of the page, with the models that have their keys."""

NOTES = {
    "[[load]]": "Either `node_set` and `force`, or `file`.",
    "[gravity]": "`acceleration` is a vector, or rows over time.",
    "[wind]": "`velocity` is a vector, or rows over time.",
    "[[wall]]": "`name`: default `wall1`, `wall2` and so on.",
    "[[constraint]]": "Kinds are modules of `pfem_petsc.contact.constraints`; none is built in.",
    "[[stage]]": "A stage has a `name` (default `stage1`, `stage2` and so on), `[stage.time]` or `[stage.static]`, and "
    "the tables that change: " + ", ".join(f"`{name}`" for name in STAGE_TABLES) + ". Of `[output]` it takes "
    "`fields_every` and `history_every`.",
    "Columns of files": "What a key `..._file` takes instead of the name of a file: a table with these keys.",
}
UNIT = re.compile(r"\s*\[((?:-|1/\w+|degrees|min|(?:[NJ]|Pa|kg|m|s|K|rad)[\w/() ^-]*?)(?:, (?:-|[NJ\w/()^ -]+?))*)\]")
HEAD = "| key | type | unit | default | meaning |\n|---|---|---|---|---|\n"


def page() -> str:
    """Return the page."""
    text = (
        "# All keys of a case file\n\n"
        "Generated from the models that validate case files; [the keys of a case file](../case_file.md) explains them, "
        "with examples. A key without default and not marked *required* may be left out. Whole numbers are accepted "
        "for numbers; rows are lists of lists.\n\n"
        "The top level of a case file has `title`, `plugins` (files with modules of your own) and the tables "
        + ", ".join(f"`{key}`" for key in KEYS[2:])
        + ".\n"
    )
    for heading, models in TABLES.items():
        text += f"\n## `{heading}`\n" if heading.startswith("[") else f"\n## {heading}\n"
        text += f"\n{NOTES[heading]}\n" if heading in NOTES else ""
        for model in models:
            text += _family(model) if isinstance(model, Family) else "\n" + _table(model, ())
    return text


def _family(family: Family) -> str:
    text = ""
    for name in choices(family.package):
        module = lookup(family.package, name, "")
        if not hasattr(module, "Parameters"):
            continue
        without = family.models[0].model_fields
        about = (module.__doc__ or "").strip().partition("\n\n")[0].replace("\n", " ").partition(". ")[0].rstrip(".:")
        own = [key for key in module.Parameters.model_fields if key not in without]
        text += f'\n### `{family.key} = "{name}"`\n\n{_plain(about)}.\n'
        text += "\n" + _table(module.Parameters, without) if own else "\nNo keys of its own.\n"
    return text


def _table(model: type[StrictModel], without: Any) -> str:
    lines, inner = rows(model, without)
    text = HEAD + "".join(f"| {' | '.join(line)} |\n" for line in lines)
    for key, nested in inner:
        text += f"\nKeys of `{key}`:\n\n" + _table(nested, ())
    return text


def rows(model: type[StrictModel], without: Any = ()) -> tuple[list[list[str]], list[tuple[str, type[StrictModel]]]]:
    """Return the rows of a model's table, and the models of its keys that are tables themselves."""
    lines, inner = [], []
    for key, field in model.model_fields.items():
        if key in without or key == getattr(model, "slot", None):
            continue
        unit, text = _unit(_plain(model.description(key)))
        lines.append([f"`{key}`", type_text(field.annotation, field.metadata), unit, _default(field), text])
        inner += [(key, nested) for nested in _models(field.annotation)]
    return lines, inner


def _unit(text: str) -> tuple[str, str]:
    """Take the first unit out of a text."""
    found = UNIT.search(text)
    if found is None:
        return "", text
    return found[1], re.sub(r"\s+([,;:.)])", r"\1", text[: found.start()] + text[found.end() :]).strip()


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?\.?(?:[\w.]+\.)?(\w+)`", r"`\1`", " ".join(text.split()))
    return text.replace("``", "`").replace("|", "\\|").replace("<", "&lt;")


def _default(field: FieldInfo) -> str:
    value = field.default
    if field.is_required():
        return "*required*"
    if value in (None, (), []):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{x:g}' if isinstance(x, float) else str(x) for x in value)}]`"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def type_text(annotation: Any, metadata: Any = ()) -> str:
    """Return how a type is written in a case file: ``number > 0``, ``[x, y, z]``, ``"round"`` or ``"tube"``."""
    if typing.get_origin(annotation) is Annotated:
        inner, *metadata = typing.get_args(annotation)
        more = [m for each in metadata for m in (each.metadata if isinstance(each, FieldInfo) else [each])]
        return type_text(inner, more)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(type_text(each, metadata) for each in arguments if each is not type(None))
    if origin is Literal:
        return ", ".join(f'`"{each}"`' if isinstance(each, str) else f"`{str(each).lower()}`" for each in arguments)
    if origin is tuple:
        return _tuple_text(arguments)
    if origin in (dict, list) or annotation in (dict, list):
        return "table" if origin is dict or annotation is dict else "list"
    if isinstance(annotation, type) and issubclass(annotation, StrictModel):
        return "table"
    names = {float: "number", int: "whole number", bool: "`true`, `false`", str: "text"}
    return names.get(annotation, "see meaning") + _limits(metadata)


def _tuple_text(arguments: tuple[Any, ...]) -> str:
    if arguments[-1] is Ellipsis:
        inner = type_text(arguments[0])
        width = len(_row(arguments[0]))
        return f"rows of {width} numbers" if width else f"list: {inner}"
    texts = [type_text(each) for each in arguments]
    if len(set(texts)) == 1 and texts[0].startswith("whole number"):
        return f"{len(texts)} whole numbers{texts[0][12:]}"
    if len(set(texts)) == 1 and texts[0].startswith("number"):
        return {2: "[a, b]", 3: "[x, y, z]", 4: "[t, x, y, z]"}.get(len(texts), f"{len(texts)} numbers") + texts[0][6:]
    return f"[{', '.join(texts)}]"


def _row(annotation: Any) -> tuple[Any, ...]:
    """The numbers of a row; nothing for what is no row."""
    if typing.get_origin(annotation) is Annotated:
        return _row(typing.get_args(annotation)[0])
    numbers = typing.get_args(annotation) if typing.get_origin(annotation) is tuple else ()
    return numbers if numbers and Ellipsis not in numbers else ()


def _limits(metadata: Any) -> str:
    found = {}
    for each in metadata:
        for name, sign in (("gt", ">"), ("ge", "≥"), ("lt", "&lt;"), ("le", "≤")):
            limit = getattr(each, name, None)
            if limit is not None and abs(limit) < 2**62:
                found[sign] = f" {sign} {limit:.6g}"
    return ",".join(found.values())


def _models(annotation: Any) -> Iterator[type[StrictModel]]:
    """Models in a type."""
    if isinstance(annotation, type) and issubclass(annotation, StrictModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models(argument)


if __name__ == "__main__":
    print(page(), end="")
