"""Pages of the documentation: their prose, blocks and commands; the plugins of the folder examples."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from pfem_petsc import Simulation

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md")])
TEXT = (DOCS / "extending.md").read_text()
EXAMPLES = ROOT / "examples"
PLUGINS = {path.name: path.read_text() for path in sorted(EXAMPLES.glob("*.py"))}
SPIN = (EXAMPLES / "polygon_spin.toml").read_text().partition("\ntitle")
SPIN = "".join(SPIN[1:]).lstrip()
"""The case of the examples, without the key that names the plugins."""


def blocks(page: Path, *languages: str) -> list[str]:
    """Texts of the blocks of a page in these languages; ``""`` is a block without one."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return [text for name, text in fenced if name in languages]


def prose(page: Path) -> str:
    """A page without its blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def program_lines(page: Path) -> list[list[str]]:
    """Words after ``python -m pfem_petsc`` of the lines that begin so in blocks of commands."""
    lines = "".join(blocks(page, "", "sh", "bash")).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines if line.startswith("python -m pfem_petsc ")]
    return [line[3:] for line in words]


def run(case, comm, folder, **options):
    with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
        simulation.run()
        comm.Barrier()
        return simulation
