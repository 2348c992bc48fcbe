"""Sections of docstrings (Parameters, Returns, Raises and so on) as lists, with names and texts as they are written."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

NAMES = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*) : (.*)$")
LISTS = ("Parameters", "Attributes", "Raises", "Returns")
PARTS = re.compile(r"; (\*{0,2}\w+(?:, \*{0,2}\w+)*) : ")


def _names(text: str) -> str:
    return ", ".join(f"``{name}``" for name in text.split(", "))


def _item(line: str) -> str:
    """A line of a section that begins an item."""
    found = NAMES.match(line)
    if found is None:
        return f"- {line}"
    return f"- {_names(found[1])}: " + PARTS.sub(lambda m: f"; {_names(m[1])}: ", found[2])


def _as_lists(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    made: list[str] = []
    section = ""
    for line, following in zip(lines, [*lines[1:], ""]):
        if re.fullmatch(r"-{3,}", following) and line:
            section = line
            made += [f"**{section}**", ""]
        elif re.fullmatch(r"-{3,}", line):
            continue
        elif section not in LISTS or not line:
            made.append(line)
        elif line.startswith(" "):
            made.append("  " + line.strip())
        elif section == "Raises" and re.fullmatch(r"\w+", line):
            made.append(f"- :exc:`{line}`" + (":" if following.startswith(" ") else ""))
        else:
            made.append(_item(line))
    lines[:] = made


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the reading of docstrings."""
    app.connect("autodoc-process-docstring", _as_lists)
    return {"parallel_read_safe": True}
