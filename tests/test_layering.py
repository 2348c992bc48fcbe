"""Imports never climb: a folder of the package imports only from lower floors, even within functions.

Modules that are named in strings, for ``lookup``, count, and so do imports for annotations (``if TYPE_CHECKING:``), but
for those of :data:`ANNOTATED`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "pfem_petsc"

FLOORS = (
    ("columns", "errors", "signals", "tolerances", "version"),
    ("files",),
    ("registry",),
    ("parallel",),
    ("cases",),
    ("case.base", "case.section_shapes", "case.toml"),
    ("case.files",),
    ("case.tables",),
    ("mesh",),
    ("mechanics",),
    ("integrators",),
    ("solvers",),
    ("output",),
    ("contact",),
    ("stepping",),
    ("statics", "modes"),
    ("case",),  # above the physics whose keys it puts together
    ("restart",),
    ("preflight",),
    ("run",),
    ("simulation",),
    ("__init__",),  # the public interface
    ("bench", "post", "studies"),
    ("cli",),
    ("__main__",),
)
"""Folders and modules of the package from the lowest floor to the highest; those of one floor know nothing of each
other. A module of a folder that is not on its floor is named ``folder.module``."""

LATER = {("output/result.py", "case")}
"""Imports that may climb: a result reads its case when it is asked for."""

ANNOTATED = {
    "contact": {"case", "stepping"},
    "mechanics": {"case", "contact"},
    "mesh": {"case"},
    "solvers": {"contact", "stepping"},
    "stepping": {"case"},
    "__init__": {"studies"},
}
"""Higher floors whose types annotations of a floor may name. A new one wants a narrower argument."""

PARTS = {"formats": "mesh"}
"""Folders that are parts of another one: a mesh may come from a file, and what is in a file is a mesh."""

FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}


def imports(path: Path, package: Path) -> Iterator[tuple[int, str, bool]]:
    """Line, folder or module, and whether it is for annotations alone, of each import of the package's parts in a file.

    A string that is the name of a part counts as an import of it; the registry has words for folders.
    """
    # the package that relative imports of the file start from, below the root of all
    here = path.relative_to(package).parts[:-1]
    tree = ast.parse(path.read_text(), str(path))
    guards = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    types = {id(inner) for guard in guards for part in guard.body for inner in ast.walk(part)}
    for node in ast.walk(tree):
        found: list[tuple[str, ...]] = []
        if isinstance(node, ast.Import):
            names = (alias.name.split(".") for alias in node.names)
            found = [tuple(name[1:]) for name in names if name[0] == package.name]
        elif (
            path.name != "registry.py"
            and isinstance(node, ast.Constant)
            and re.fullmatch(rf"{package.name}(\.\w+)+", str(node.value))
        ):
            found = [tuple(node.value.split(".")[1:])]
        elif isinstance(node, ast.ImportFrom):
            base = tuple(node.module.split(".")) if node.module else ()
            if node.level:
                base = here[: len(here) - node.level + 1] + base
            elif base[0] == package.name:
                base = base[1:]
            else:
                continue
            # of the package itself: its parts, or names of its public interface
            found = [(*base, alias.name) for alias in node.names]
        for target in found:
            yield node.lineno, floor_name(target, package), id(node) in types


def floor_name(target: tuple[str, ...], package: Path) -> str:
    """The name in :data:`FLOORS` of a module, or of a name in one, by its parts below the package."""
    if ".".join(target[:2]) in FLOOR:
        return ".".join(target[:2])
    top = target[0] if target else "__init__"
    top = PARTS.get(top, top)
    return top if (package / top).is_dir() or (package / f"{top}.py").exists() else "__init__"


def climbing(package: Path) -> list[str]:
    """File, line and what is wrong, of each import that does not go to a floor below."""
    wrong = []
    for path in sorted(package.rglob("*.py")):
        inside = path.relative_to(package)
        own = floor_name(inside.with_suffix("").parts, package)
        if own not in FLOOR:
            wrong.append(f"{path}: {own!r} has no floor in {Path(__file__).name}")
            continue
        for line, other, types in imports(path, package):
            if (inside.as_posix(), other) in LATER or (types and other in ANNOTATED.get(own, ())):
                continue
            if other != own and FLOOR.get(other, len(FLOORS)) >= FLOOR[own]:
                wrong.append(f"{path}:{line}: {own} (floor {FLOOR[own]}) imports {other} (floor {FLOOR.get(other)})")
    return wrong


@pytest.mark.slow
def test_no_import_climbs():
    assert climbing(PACKAGE) == []


def test_every_floor_exists():
    names = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert names == {name for name in (*FLOOR, *PARTS) if "." not in name}
    assert all((PACKAGE / f"{name.replace('.', '/')}.py").exists() for name in FLOOR if "." in name)


@pytest.mark.parametrize(
    "text",
    [
        "from ..stepping.stepper import Stepper",
        "def f():\n    from ..stepping import stepper",
        "import pfem_petsc.stepping.stepper",
        "from pfem_petsc.stepping import stepper",
        "from .. import stepping",
        "from pfem_petsc import Simulation",
        "if TYPE_CHECKING:\n    from .. import Simulation",
        'walls = lookup("pfem_petsc.stepping.walls", name)',
    ],
)
def test_a_climbing_import_is_found_with_its_line(tmp_path, text):
    package = tmp_path / "pfem_petsc"
    for folder in ("contact", "stepping", "mechanics"):
        (package / folder).mkdir(parents=True)
    (package / "contact" / "one.py").write_text(f"from ..mechanics import bars\nfrom . import two\n{text}\n")
    line = 3 + text.count("\n")
    (found,) = climbing(package)
    assert f"contact/one.py:{line}: contact" in found
    assert "stepping" in found or "__init__" in found
