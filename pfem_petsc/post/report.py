"""A report of a run as one HTML file without references to others."""

from __future__ import annotations

import base64
import html
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, written
from ..output.layout import EVENT
from ..output.table import Table, html_table
from ..output.units import engineering
from .chart import opened
from .plot import plot

NAME = "report.html"
SIZE = (1600, 900)
"""Pixels of the picture of the truss."""

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1f242c; background: #fff; margin: 0 auto;
  max-width: 66rem; padding: 1rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 1rem 0 .25rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #d5d9df; padding-bottom: .2rem; }
p.lead { color: #4a5260; margin-top: 0; }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; } nav a { color: #0072B2; }
table { border-collapse: collapse; margin: .4rem 0 1rem; display: block; overflow-x: auto; max-width: 100%; }
th, td { text-align: left; padding: .2rem .9rem .2rem 0; vertical-align: top; border-bottom: 1px solid #eceef1; }
th { font-weight: 600; } td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; display: block; }
figcaption { color: #4a5260; font-size: .9rem; }
pre { background: #f5f6f8; padding: .8rem 1rem; overflow-x: auto; font-size: .85rem; line-height: 1.4; }
.warning { border-left: 4px solid #D55E00; background: #fdf3ec; padding: .5rem .9rem; margin: .5rem 0;
  white-space: pre-wrap; overflow-wrap: anywhere; }
@media print { nav { display: none; } h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


def write_report(
    result_path: Path | str | Any,
    output: Path | str | None = None,
    *,
    pictures: bool = True,
    force_filter: str | None = None,
    field: str = "stress",
) -> Path:
    """Write case, summary, warnings, pictures, curves, energies, events, modes and cost of a run into one HTML file.

    Pictures are inside the file, which opens without a network. An earlier report is replaced.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    output : the file; None: ``report.html`` beside the result
    pictures : whether to draw the truss; where that is not possible, the report says why
    force_filter : of the forces: see :func:`~pfem_petsc.post.curves.make_filter`
    field : that colours the bars

    Raises
    ------
    InputError
        If the result cannot be read, its history is empty, or the file cannot be written.
    """
    with opened(result_path) as result:
        file = Path(output) if output is not None else Path(result.path).parent / NAME
        if file.is_dir():
            raise InputError(f"{file}: is a folder; name a file for the report, {file / NAME}")
        with tempfile.TemporaryDirectory() as folder:
            curves = plot(result, folder, force_filter=force_filter)
            truss = (
                _truss(result, Path(folder, "truss.png"), field) if pictures else _NO_PICTURES.format("not asked for")
            )
            text = _document(result, curves, truss)
    with written(file, "the report"):
        file.write_text(text, encoding="utf-8")
    return file


_NO_PICTURES = "<p>No pictures of the truss: {}</p>"


def _truss(result: Any, file: Path, field: str) -> str:
    """Return six instants of the truss, drawn into a file, or why there are none."""
    from .options import Options
    from .render import Film, save

    try:
        film = Film([result], Options(field=field, size=SIZE), lambda text: None)
        save(film.poster(), file)
    except InputError as error:
        return _NO_PICTURES.format(html.escape(str(error)))
    film.close()
    return _figure(file, "Instants, or ends of load cases, coloured by the field named beside the scale")


def _document(result: Any, curves: Sequence[Path], truss: str) -> str:
    case, log = result.case, _log(result)
    title = case.title or case.name
    sections = {
        "Summary": html_table(result.summary().items()),
        "Warnings": "".join(f'<div class="warning">{html.escape(text)}</div>' for text in log["warnings"])
        or "<p>None.</p>",
        "Load cases": _load_cases(result),
        "Members": _members(result),
        "Truss": truss,
        "Curves": "".join(_figure(path, path.stem.replace("_", " ").capitalize()) for path in curves),
        "Crush tests": _crush(result),
        "Events": _events(result),
        "Modes": result.modes.table().to_html() if result.n_modes else "",
        "Cost": html_table(_cost(result, log).items()),
        "Case": f"<p>All keys, with defaults:</p><pre>{html.escape(result.case_text.strip())}</pre>",
        "Versions": html_table(
            (key, str(value)) for key, value in result.attributes.items() if value not in ("", {}, [])
        ),
    }
    shown = {name: body for name, body in sections.items() if body}
    marks = {name: name.lower().replace(" ", "-") for name in shown}
    links = "".join(f'<a href="#{marks[name]}">{name}</a>' for name in shown)
    body = "".join(f'<h2 id="{marks[name]}">{name}</h2>{content}' for name, content in shown.items())
    time = result.history["time"]
    span = result.axis.span(float(time[0]), float(time[-1]))
    lead = f"{result.n_nodes:,} nodes, {result.n_bars:,} bars · {span}"
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>"
        f'<h1>{html.escape(title)}</h1><p class="lead">{html.escape(lead)}</p><nav>{links}</nav>{body}</body></html>\n'
    )


def _load_cases(result: Any) -> str:
    """The reaction, the largest displacement and the governing member of each load case and combination."""
    cases = [stage for stage in result.case.stages if stage.starts_from is not None]
    if not cases or not len(result.times):
        return ""
    from .members import instants_of, unfinished

    start, history, lines = np.asarray(result.positions(0), dtype=float), result.history, []
    steps = np.asarray(history["step"])
    left = unfinished(result)
    missing = f"<p>Not computed to their ends: {html.escape(', '.join(left))}</p>" if left else ""
    for instant in instants_of(result, None, None) if len(left) < len(cases) else ():
        moved = np.linalg.norm(result.positions(instant.snapshot) - start, axis=1)
        row = np.flatnonzero(steps == result.steps[instant.snapshot])
        force = np.asarray(history["support_force"])[row[-1]] if len(row) and "support_force" in history else ()
        least = 1e-9 * max(map(abs, force), default=0.0)  # below is rounding
        reaction = ", ".join(engineering(float(value) if abs(value) > least else 0.0, "N") for value in force)
        lines.append([instant.case, engineering(float(moved.max()), "m"), f"node {moved.argmax()}", reaction])
    head = ["load case or combination", "largest displacement", "", "force of the supports (x, y, z)"]
    return missing + (html_table(lines, head) if lines else "")


_MOST_MEMBERS = 20


def _members(result: Any) -> str:
    """The members with the highest utilisation, if any has one."""
    from .members import members

    try:
        table = members(result)
    except (InputError, OSError) as error:
        return f"<p>No table of members: {html.escape(str(error))}</p>"
    known = np.isfinite(table["yield_utilisation"]) | np.isfinite(table["buckling_utilisation"])
    if not known.any():
        return ""
    head = ["bars", "section", "length", "axial force", "stress", "of strength", "of Euler's load", "case", "at"]
    lines = [
        [
            str(row["bars"]),
            str(row["section"]),
            engineering(float(row["length"]), "m"),
            engineering(float(row["axial_force"]), "N"),
            engineering(float(row["stress"]), "Pa"),
            *("" if np.isnan(row[name]) else f"{100.0 * row[name]:.1f} %" for name in table if "utilisation" in name),
            str(row["case"]),
            result.place(float(row["time"])),
        ]
        for row in table.where(slice(_MOST_MEMBERS)).rows
    ]
    more = table.n_rows - len(lines)
    rest = f"<p>The command members lists the other {more:,}.</p>" if more else ""
    return html_table(lines, head) + rest


_CRUSHED = 0.05
"""Least strain of a block that a wall compresses, from which its figures are in the report."""


def _crush(result: Any) -> str:
    """The figures of what moving walls compress, with the box around the mesh for area and height."""
    from .crush import crush, draw_crush

    found = ""
    for wall in result.case.every_wall:
        if f"wall/{wall.name}/position" not in result.history:
            continue
        try:
            test = crush(result, wall.name)
        except (InputError, OSError):
            continue  # it touches nothing, or the mesh is not there any more
        if test.strain[-1] < _CRUSHED:
            continue
        with tempfile.TemporaryDirectory() as folder:
            picture = _figure(draw_crush(test, Path(folder) / "crush.png"), f"Wall {wall.name}: stress and strain")
        found += f"<p>Wall {html.escape(wall.name)}, area and height of the box around the mesh:</p>"
        found += html_table(test.texts().items()) + picture
    return found


def _events(result: Any) -> str:
    history = result.history
    names = [name for name in history if name.startswith(f"{EVENT}/")]
    if not names or not len(history[names[0]]):
        return ""
    table = Table({name.removeprefix(f"{EVENT}/"): history[name] for name in names})
    more = f"<p>{table.n_rows - 50:,} more are in the result.</p>" if table.n_rows > 50 else ""
    return table.where(slice(50)).to_html() + more


def _log(result: Any) -> dict[str, list[str]]:
    """Return warnings, closing lines and memory from the log beside the result."""
    file = Path(result.path).parent / "log.txt"
    text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    entries = re.findall(r"^\S+ \S+ (\w+) +(.*(?:\n(?!\d{4}-\d\d-\d\d ).*)*)", text, flags=re.MULTILINE)
    told = [message.strip() for level, message in entries if level not in ("WARNING", "ERROR")]
    return {
        "warnings": list(dict.fromkeys(text.strip() for level, text in entries if level in ("WARNING", "ERROR"))),
        "done": [text.removeprefix("done: ") for text in told if text.startswith(("done:", "stopped"))],
        "memory": [text.removeprefix("memory").strip() for text in told if text.startswith("memory")],
    }


def _cost(result: Any, log: Mapping[str, list[str]]) -> dict[str, str]:
    done = log["done"] or ["not finished, or its log is not beside the result"]
    rows = {"run" if k == 0 else f"continued ({k})": text for k, text in enumerate(done)}
    rows |= {"memory": log["memory"][-1]} if log["memory"] else {}
    rows["ranks"] = str(result.attributes.get("ranks", "?"))
    rows["result file"] = f"{Path(result.path).stat().st_size / 1e6:.3g} MB"
    totals = {name: int(np.sum(result.history.get(name, 0))) for name in ("newton_iterations", "linear_iterations")}
    return rows | {name.replace("_", " "): f"{n:,} in the rows of the history" for name, n in totals.items() if n}


def _figure(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
