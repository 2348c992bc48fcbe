"""What pages say about the checkout and has no page in the site.

Links to folders become plain text; links to files are downloads. In lists of pages a pattern may match nothing.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

LINK = re.compile(r"(?<!!)\[([^\]\n]+)\]\(([^)\s#]+)\)")
PATTERN = re.compile(r"^([\w/.]+)\*\n", flags=re.MULTILINE)


def _without_folders(app: Sphinx, name: str, source: list[str]) -> None:
    here = Path(app.srcdir, name).parent
    source[0] = LINK.sub(lambda m: m[1] if (here / m[2]).is_dir() else m[0], source[0])
    if name == app.config.root_doc:
        source[0] = PATTERN.sub(lambda m: m[0] if any(here.glob(f"{m[1]}*.md")) else "", source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to the reading of pages."""
    app.connect("source-read", _without_folders)
    return {"parallel_read_safe": True}
