"""What the scripts that write the documentation share: tables, parts of pages between marks, runs, small pictures."""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pfem_petsc import Case
    from pfem_petsc.output.result import Result

DOCS = Path(__file__).resolve().parent.parent / "docs"


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown, without a line break at its end."""
    names = "|".join(f" {name} " if name else " " for name in head)
    return "\n".join([f"|{names}|", "|---" * (names.count("|") + 1) + "|", *(f"| {' | '.join(row)} |" for row in rows)])


def replaced(page: str, start: str, end: str, text: str) -> str:
    """Return a page with another text between two marks.

    Raises
    ------
    SystemExit
        If the page does not have the marks.
    """
    before, found, rest = page.partition(start)
    if not found or end not in rest:
        raise SystemExit(f"the page has no part between {start.strip()} and {end.strip()}")
    return before + start + text + rest[rest.index(end) :]


def insert(name: str, start: str, end: str, text: str) -> None:
    """Write a text between its marks in a page of docs/."""
    (DOCS / name).write_text(replaced((DOCS / name).read_text(), start, end, text))


@contextmanager
def finished(case: Case) -> Iterator[Result]:
    """Run a case on one rank in a temporary folder, and give its result."""
    from mpi4py import MPI

    from pfem_petsc import Simulation, open_result

    with tempfile.TemporaryDirectory() as folder:
        with Simulation(case, MPI.COMM_SELF, output=folder, quiet=True) as simulation:
            simulation.run()
        yield open_result(folder)


def program(*words: Any, cwd: Path | None = None) -> str:
    """Run the command line of the program, which must succeed, and return what it prints."""
    line = [sys.executable, "-m", "pfem_petsc", *map(str, words)]
    return subprocess.run(line, cwd=cwd, check=True, stdout=subprocess.PIPE, text=True).stdout


def save(picture: Figure | Path, file: Path, dpi: float = 100, width: int | None = None) -> None:
    """Write a figure, or a picture in a file, as a compact PNG: of a palette of 256 colours, at most so wide."""
    from PIL import Image

    source = picture
    if not isinstance(picture, Path):
        source = io.BytesIO()
        picture.savefig(source, dpi=dpi)
    image = Image.open(source).convert("RGB")
    if width is not None and image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    file.parent.mkdir(parents=True, exist_ok=True)
    image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(file, optimize=True)
