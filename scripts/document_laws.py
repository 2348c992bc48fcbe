"""The keys of the material laws in docs/case_file.md, from the ``Parameters`` of each law.

    python scripts/document_laws.py            # rewrites the part between the two marks

A key is documented by the text below it in its class.
"""

from __future__ import annotations

from typing import Any

from pages import DOCS, insert, markdown
from pydantic_core import PydanticUndefined

from pfem_petsc.mechanics.materials.base import LAWS, MaterialKeys
from pfem_petsc.registry import choices, lookup

FILE = DOCS / "case_file.md"
BEGIN, END = "<!-- laws: made by scripts/document_laws.py -->\n", "<!-- end of laws -->\n"


def text_of(name: str) -> str:
    """Return what the documentation says about a law; ``""`` for the keys of all materials."""
    if not name:
        return _table("every material", MaterialKeys, ())
    module = lookup(LAWS, name, "")
    title = (module.__doc__ or "").strip().partition("\n")[0].rstrip(".")
    text = f"#### `{name}`\n\n{title}.\n\n"
    if set(module.Parameters.model_fields) - set(MaterialKeys.model_fields):
        text += _table("key", module.Parameters, MaterialKeys.model_fields)
    variables = ", ".join(f"`{label}`" + (f" [{unit}]" if unit else "") for label, unit in module.LAW.internal)
    return text + (f"Internal variables: {variables}.\n\n" if variables else "")


def undocumented(name: str) -> list[str]:
    """Return the keys of a law that have no text."""
    model = lookup(LAWS, name, "").Parameters
    return [key for key in model.model_fields if not model.description(key)]


def _table(head: str, model: type[MaterialKeys], without: Any) -> str:
    rows = []
    for key, field in model.model_fields.items():
        text = " ".join(model.description(key).split()).replace("``", "`").replace("|", "\\|")
        rows.append([f"`{key}`", _default(field.default), text])
    rows = [row for row in rows if row[0].strip("`") not in without]
    return markdown([head, "default", ""], rows) + "\n\n"


def _default(value: Any) -> str:
    if value is PydanticUndefined or value is None:
        return "" if value is None else "required"
    return f'`"{value}"`' if isinstance(value, str) else f"{value:g}"


def main() -> None:
    """Rewrite the file."""
    insert(FILE.name, BEGIN, END, "\n" + "".join(text_of(name) for name in ("", *choices(LAWS))))


if __name__ == "__main__":
    main()
