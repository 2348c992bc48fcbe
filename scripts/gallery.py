"""Writes docs/gallery.md from docs/gallery.toml: every built-in case with a picture, its cost and a checked number.

python scripts/gallery.py                  # the page alone
python scripts/gallery.py --run [CASE ...] # runs the cases on one rank, measures and draws them; and the page
python scripts/gallery.py --draw [CASE ...] # the same without measuring, on a machine with other load
"""

from __future__ import annotations

import argparse
import re
import shutil
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from pages import DOCS, program, save

from pfem_petsc import open_result
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_path, read_text
from pfem_petsc.output.units import prefix_for

DATA = DOCS / "gallery.toml"
PAGE = DOCS / "gallery.md"
PICTURES = DOCS / "images" / "gallery"
SIZE = "960x540"

HEAD = """# Gallery

This page shows the built-in cases. A test runs each case (some of them shortened) and compares the listed result
([tests/cases/test_built_in_cases.py](../tests/cases/test_built_in_cases.py)). Times are for one core of a virtual
machine, without the start of Python and the compilation of the loops in the very first run. `scripts/gallery.py` runs
the cases, draws the pictures and writes this page from [gallery.toml](gallery.toml).

```
python -m pfem_petsc CASE
python -m pfem_petsc render results/CASE
```
"""


def entries() -> dict[str, dict[str, Any]]:
    """Return the entries by case."""
    return tomllib.loads(DATA.read_text())


def page() -> str:
    """Return the page."""
    return HEAD + "".join(_section(name, entry) for name, entry in entries().items())


def _section(name: str, entry: dict[str, Any]) -> str:
    title = Case.load(name).title
    cost = "a moment" if entry["seconds"] < 0.1 else f"{entry['seconds']:.2g} s"
    steps = (
        f", {entry['steps']:,} step{'s' * (entry['steps'] > 1)}" if entry["steps"] else ", modes of the initial state"
    )
    rows = [
        ("", ""),
        ("---", "---"),
        ("size and cost", f"{entry['bars']:,} bar{'s' * (entry['bars'] > 1)}{steps}, {cost}"),
        ("result", f"{entry['quantity']}: {_number(entry)}"),
        ("reference", entry["reference"]),
        ("test", f"`{name}`" + (f", with `{entry['smaller']}`" if "smaller" in entry else "")),
        ("case file", f"[{name}.toml](../pfem_petsc/cases/{name}.toml)"),
    ]
    table = "\n".join(f"| {left} | {right} |" for left, right in rows).replace("| --- | --- |", "|---|---|")
    comments = re.match(r"(?:#.*\n)+", read_text(built_in_path(name)))[0].splitlines()
    about = " ".join(line.lstrip("# ") for line in comments).partition("python -m")[0].partition("mpirun")[0]
    about = re.split(r"(?<=[.:])\s", about.strip())[0].rstrip(".:")
    return f"\n## `{name}`\n\n![{title}](images/gallery/{name}.png)\n\n{about}.\n\n{table}\n"


def _number(entry: dict[str, Any]) -> str:
    factor, unit = prefix_for(entry["value"], entry.get("unit", ""))
    if unit in ("", "°"):
        return f"{entry['value']:.6g}{unit} ± {entry['tolerance']:.2g}{unit}"
    return f"{factor * entry['value']:.7g} {unit} ± {factor * entry['tolerance']:.2g} {unit}"


def measure(name: str, folder: Path) -> dict[str, Any]:
    """Run a case twice, so that nothing is compiled in the second run, and return what that cost."""
    for _ in range(2):
        shutil.rmtree(folder / "run", ignore_errors=True)
        program(name, "-o", folder / "run")
    found = re.findall(r"done: .* in ([\d.]+) (s|min)\b", (folder / "run" / "log.txt").read_text())
    seconds = float(found[-1][0]) * (60.0 if found[-1][1] == "min" else 1.0) if found else 0.0
    result = open_result(folder / "run")
    return {"bars": len(result.bars), "steps": int(result.history["step"][-1]), "seconds": seconds}


def draw(name: str, folder: Path) -> None:
    """Draw the result in a folder."""
    entry, count = entries()[name], len(open_result(folder / "run").times)
    options = ["--size", SIZE, "--video", "none", "--no-poster", *entry["render"]]
    if "modes" in entry:
        options += ["--modes", entry["modes"], "--frames", "4"]
    else:
        options += ["--frames", f"0,{entry['frame'] % count}"]
    program("render", folder / "run", "-o", folder / "pictures", *options)
    frames = sorted((folder / "pictures").rglob("*.png"))
    save(frames[1 if "modes" in entry else -1], PICTURES / f"{name}.png")


def _record(name: str, cost: dict[str, Any]) -> None:
    """Put the cost into the entry of a case."""
    text = DATA.read_text()
    section = re.search(rf"^\[{name}\]\n(?:(?!\[).*\n)*?(?=\n|\Z)", text, flags=re.MULTILINE)
    kept = re.sub(r"^(bars|steps|seconds) = .*\n", "", section[0], flags=re.MULTILINE)
    shown = {key: f"{value:.3g}" if key == "seconds" else value for key, value in cost.items()}
    lines = "".join(f"{key} = {value}\n" for key, value in shown.items())
    DATA.write_text(text[: section.start()] + kept + lines + text[section.end() :])


def main() -> None:
    """Run what is asked for and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--run", nargs="*", metavar="CASE", help="run, measure, draw these cases; without names: all")
    parser.add_argument("--draw", nargs="*", metavar="CASE", help="run and draw these cases; without names: all")
    arguments = parser.parse_args()
    for chosen, measured in ((arguments.draw, False), (arguments.run, True)):
        for name in chosen or entries() if chosen is not None else ():
            with tempfile.TemporaryDirectory() as folder:
                if measured:
                    _record(name, measure(name, Path(folder)))
                else:
                    program(name, "-o", Path(folder, "run"))
                draw(name, Path(folder))
            print(name, flush=True)
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
