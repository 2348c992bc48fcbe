"""Configuration of the site: ``scripts/docs.sh`` builds it from the Markdown pages of the checkout.

The source folder is the root of the checkout, so that links between ``docs``, README.md and CONTRIBUTING.md are the
same here and where the files are read as they are. Nothing of the result asks the network for anything.
"""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent / "scripts"), str(HERE.parent)]

from pfem_petsc import __version__  # noqa: E402

project = "pfem_petsc"
author = "the pfem_petsc authors"
release = version = __version__
copyright = author  # noqa: A001
root_doc = "docs/index"
include_patterns = ["docs/**", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"]
exclude_patterns = [".*", "build", "results", "docs/_*", "docs/images", "docs/reference/README.md"]

extensions = [
    *("myst_parser", "sphinx.ext.autodoc"),
    *("mathml", "checkout_links", "docstrings", "case_keys"),
]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 5
suppress_warnings = ["myst.header"]

html_theme = "furo"
html_title = f"pfem_petsc {release}"
html_static_path = ["_static"]
html_extra_path = ["_extra"]  # index.html leads to docs/index.html
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False

autodoc_typehints_format = "short"
python_maximum_signature_line_length = 90
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
# What types of other libraries and texts such as "(nodes, 3) [m]" look like to a cross-reference.
nitpick_ignore_regex = [("py:.*", ".*")]
