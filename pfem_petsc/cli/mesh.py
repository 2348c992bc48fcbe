"""Generate, convert, inspect, draw, refine, merge and clean mesh files."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, printable, written
from .main import PROGRAM, Action, Verb, argument, setting

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh

EXAMPLE = f"""\
examples:
  {PROGRAM} mesh generate lattice block.inp --set kind=octet cells=[4,4,4] pitch=0.01 --area 1e-6
  {PROGRAM} mesh convert tower.inp tower.vtu --scale 0.001 --case tower.toml
  {PROGRAM} mesh info meshes/ring.msh
  {PROGRAM} mesh picture meshes/mast.vtu -o mast.png
  {PROGRAM} mesh refine cable.msh fine.msh --parts 8
  {PROGRAM} mesh merge deck.h5 towers.inp -o bridge.h5 --tolerance 1e-4
  {PROGRAM} mesh clean scanned.stl truss.3mf --tolerance 1e-5 --area 1e-6

The suffix chooses the format: docs/meshes.md."""


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and 50 <= int(width) <= 20000 and 50 <= int(height) <= 20000):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size in pixels, like 1280x720")
    return int(width), int(height)


def _distance(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


INPUT, OUTPUT = (argument(name.lower(), metavar=name, type=Path) for name in ("INPUT", "OUTPUT"))
TOLERANCE = argument(
    "--tolerance",
    metavar="METRES",
    type=_distance,
    help="distance up to which nodes are at the same position; default: 1e-6 of the mean length of the bars",
)
SCALE = argument(
    "--scale",
    metavar="METRES",
    type=float,
    default=1.0,
    help="metres per unit of the file: 0.001 for millimetres, with MPa and t/mm3",
)
WRITTEN = (
    argument("--area", metavar="M2", type=_distance, help="area of all bars; replaces that of the file"),
    argument("--case", metavar="TOML", type=Path, help="also write a case file for OUTPUT"),
)
ACTIONS = (
    Action(
        "generate",
        "Write the mesh of a generator or a case.",
        (
            argument("what", metavar="GENERATOR|CASE", help="name of a generator (see list), or a case"),
            OUTPUT,
            setting("keys of the generator, kind=octet pitch=0.01, or of the case, mesh.pitch=0.01"),
            *WRITTEN,
        ),
    ),
    Action("convert", "Write a mesh file in another format.", (INPUT, OUTPUT, SCALE, *WRITTEN)),
    Action(
        "refine",
        "Divide each bar into several.",
        (
            INPUT,
            OUTPUT,
            argument("--parts", metavar="N", type=int, default=2, help="number of bars that replace one; default: 2"),
            SCALE,
            *WRITTEN,
        ),
    ),
    Action(
        "merge",
        "Merge several files, and join nodes at the same position.",
        (
            argument("inputs", metavar="INPUT", type=Path, nargs="+"),
            argument("-o", "--output", metavar="OUTPUT", type=Path, required=True),
            TOLERANCE,
            SCALE,
            *WRITTEN,
        ),
    ),
    Action(
        "clean",
        "Merge nodes, remove double bars, bars without length, and nodes without bars.",
        (
            INPUT,
            OUTPUT,
            argument("--sum-areas", action="store_true", help="add up the areas of bars between the same nodes"),
            TOLERANCE,
            SCALE,
            *WRITTEN,
        ),
    ),
    Action(
        "info",
        "Show counts, sizes, groups and defects of mesh files.",
        (argument("inputs", metavar="FILE", type=Path, nargs="+"), TOLERANCE, SCALE),
    ),
    Action(
        "picture",
        "Draw a mesh file.",
        (
            INPUT,
            argument("-o", "--output", metavar="PNG", type=Path, help="default: INPUT with the suffix .png"),
            argument("--size", metavar="WxH", type=_size, default=(1280, 720), help="pixels; default: 1280x720"),
            argument("--view", default="auto", help="xy, xz, yz, iso or auto; default: %(default)s"),
            SCALE,
        ),
    ),
)


def run(arguments: argparse.Namespace) -> int:
    """Do what the subcommand says, and return the exit status."""
    from ..formats import writer_of
    from ..mesh.tools import cleaned, merged, refined

    def inputs() -> list[WholeMesh]:
        paths = arguments.inputs if "inputs" in arguments else [arguments.input]
        return [_read(path, arguments.scale) for path in paths]

    match arguments.action:
        case "generate":
            writer_of(arguments.output)  # before a long computation
            _write(arguments, _made(arguments.what, arguments.overrides))
        case "convert":
            _write(arguments, *inputs())
        case "refine":
            _write(arguments, refined(*inputs(), arguments.parts))
        case "merge":
            _write(arguments, *merged(inputs(), arguments.tolerance))
        case "clean":
            mesh, done = cleaned(*inputs(), arguments.tolerance, arguments.sum_areas)
            _write(arguments, mesh, done or ["nothing to clean"])
        case "info":
            _info(arguments)
        case "picture":
            _picture(arguments)
    return 0


def _read(path: Path, scale: float) -> WholeMesh:
    """Read a file, and print what its reader has to say."""
    from ..formats import read_whole
    from ..mesh.tools import scaled

    mesh = read_whole(path)
    _tell(f"warning: {text}" for text in mesh.warnings)
    mesh.warnings = []
    return mesh if scale == 1.0 else scaled(mesh, scale)


def _write(arguments: argparse.Namespace, mesh: WholeMesh, done: Sequence[str] = ()) -> None:
    """Write the mesh, and a case file if there is to be one; print what was ``done`` to it, and what they are."""
    import numpy as np

    from ..formats import write_whole
    from ..mesh.whole import skeleton

    _tell(done)
    if arguments.area is not None:
        mesh.bar_fields["area"] = np.full(len(mesh.bars), arguments.area)
        for keys in mesh.tables.get("section", {}).values():
            keys.update(area=arguments.area)
            keys.pop("area_field", None)
    if arguments.case is not None and arguments.case.exists():
        raise InputError(f"--case {arguments.case}: this file exists; remove it, or give another name")
    path = write_whole(arguments.output, mesh)
    _tell([f"{arguments.output}: {len(mesh.points):,} nodes, {len(mesh.bars):,} bars"])
    if arguments.case is not None:
        with written(arguments.case, "the case"):
            arguments.case.write_text(skeleton(mesh, path, arguments.case), encoding="utf-8")
        _tell([f"{arguments.case}: a case for this mesh; see the comments at its top"])


def _made(what: str, overrides: list[str]) -> WholeMesh:
    import numpy as np
    from mpi4py import MPI

    from ..case.schema import Case
    from ..mechanics.bars import section_of_bars, select
    from ..mesh import load_slab
    from ..mesh.whole import WholeMesh
    from ..registry import choices

    plain = what in choices("pfem_petsc.mesh.generators")
    if plain:
        tables: dict[str, Any] = {
            "mesh": {"generator": what},
            "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "time": {"integrator": "central_differences", "step": "auto", "end": 1.0},
        }
        prefixed = [text if text.startswith("mesh.") else f"mesh.{text}" for text in overrides]
        case = Case.from_dict(tables, source=f"mesh generate {what}", overrides=prefixed)
    else:
        case = Case.load(what, overrides)
    keys = case.mesh.parameters
    names = dict(getattr(keys, "bar_fields", None) or getattr(getattr(keys, "truss", None), "bar_fields", None) or {})
    if case.mesh.file is not None:
        from ..formats import read_whole

        whole = read_whole(case.mesh.file)
        names = whole.bar_fields | whole.node_fields
    slab = load_slab(case.mesh, MPI.COMM_SELF, dict.fromkeys(names, "mesh.bar_fields"))
    select(slab, [case], MPI.COMM_SELF)
    mesh = WholeMesh(slab.points, slab.bars.astype("int64"), slab.node_groups, slab.bar_groups, dict(slab.bar_fields))
    mesh.node_fields = slab.node_fields
    if not plain:
        given, numbers = case.to_dict(), section_of_bars(case, slab)
        mesh.tables = {name: given[name] for name in ("material", "section") if name in given}
        areas = mesh.bar_fields["area"] = np.ones(len(mesh.bars))
        for number, (name, section) in enumerate(case.section.items()):
            own, area = numbers == number, section.uniform_area
            areas[own] = slab.bar_fields[section.area_field][own] if area is None else area
            # groups that values of fields select are in the file
            if section.bars is not None:
                mesh.tables["section"][name]["bars"] = str(section.bars)
    return mesh


def _tell(lines: Iterable[str]) -> None:
    for line in lines:
        print(printable(line))


def _info(arguments: argparse.Namespace) -> None:
    from ..mesh.tools import summary
    from ..output.table import aligned

    for path in arguments.inputs:
        mesh = _read(path, arguments.scale)
        _tell([str(path), *aligned(summary(mesh, arguments.tolerance))])


def _picture(arguments: argparse.Namespace) -> None:
    from ..post.page import mesh_page

    output = arguments.output or arguments.input.with_suffix(".png")
    mesh = _read(arguments.input, arguments.scale)
    if output.suffix.lower() != ".png":
        raise InputError(f"{output}: a picture is written as .png")
    data = mesh_page(mesh, arguments.size, arguments.view)
    with written(output, "the picture"):
        output.write_bytes(data)
    _tell([str(output)])


VERBS = (Verb("mesh", str(__doc__), EXAMPLE, "one", (), run, ACTIONS),)
