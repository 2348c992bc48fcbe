"""Writes docs/reference/case_keys.md, the table of all keys of a case file, before the pages are read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from document_case import page
from sphinx.application import Sphinx


def _write(app: Sphinx) -> None:
    file = Path(app.srcdir, "docs", "reference", "case_keys.md")
    text = page()
    if not file.exists() or file.read_text() != text:
        file.write_text(text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the start of a build."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True}
