"""Verbs about cases, meshes and this program: run, sweep, mesh, check a case or the machine, list, completion."""

from __future__ import annotations

import argparse
import os
import shlex
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..case.toml import built_in_cases, built_in_path
from ..errors import EarlyStop, InputError, SimulationFailure, printable, written
from ..registry import choices, description
from .main import CASE, PLUGINS, PROGRAM, Action, Verb, argument, fill, make_parser, seconds, setting, start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..case.schema import Case
    from ..mesh.whole import WholeMesh

RUN = f"""\
examples:
  mpirun -n 2 {PROGRAM} rod_impact
  mpirun -n 2 {PROGRAM} my_case.toml -o results/fine --set time.step=1e-5 mesh.elements=100
  mpirun -n 2 {PROGRAM} my_case.toml --restart
  mpirun -n 2 {PROGRAM} my_case.toml -- -log_view

exit status: 0 done, 2 invalid input, 3 the simulation failed, 4 stopped early with a checkpoint"""


OF_RUN = (
    *CASE,
    argument("-o", "--output", metavar="DIR", type=Path, help="output folder; default: results/NAME OF THE CASE"),
    argument(
        "--restart",
        metavar="FILE",
        nargs="?",
        const=True,
        help="continue from a checkpoint, or the newest of a folder; default: of the output folder; earlier "
        "--set values and plugins stay in force",
    ),
    argument("--quiet", action="store_true", help="print no progress"),
    argument(
        "--wall-time",
        metavar="TIME",
        type=seconds,
        help="stop with a checkpoint after this time: seconds, or hours:minutes:seconds",
    ),
)


def run_case(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Simulate, and return the exit status. Collective."""
    restart = arguments.restart if arguments.restart in (None, True) else Path(arguments.restart)
    case = load_case(arguments, comm)
    from ..simulation import Simulation

    output = arguments.output or Path("results", case.name)
    command = _command(arguments, case, comm.size)
    try:
        with Simulation(
            case, comm, output=output, restart=restart, quiet=arguments.quiet, wall_time=arguments.wall_time
        ) as simulation:
            given = {str(Path(file).resolve()) for file in arguments.plugins}.union(arguments.overrides)
            for option, values in (("--set", case.overrides), ("--plugin", case.added)):
                kept = [text for text in values if text not in given]
                if kept:
                    simulation.notes.append(f"as in the run that is continued: {option} {shlex.join(kept)}")
            return simulation.run() or 0
    except (EarlyStop, SimulationFailure) as error:
        if "continue with --restart" in str(error):
            raise type(error)(f"{error}\n  {command}") from error
        raise


def load_case(arguments: argparse.Namespace, comm: MPI.Comm) -> Case:
    """Return the case of the command line, read by rank 0; start PETSc with its options. Collective.

    A restart applies the ``--set`` values of the continued run, overridden by those given now, and uses its plugins.
    """
    start_petsc(arguments.petsc_options, comm.rank)
    from ..parallel.agreement import on_root

    return on_root(comm, _load, arguments)


def _load(arguments: argparse.Namespace) -> Case:
    from ..case.schema import Case

    overrides, plugins = arguments.overrides, arguments.plugins
    restart = getattr(arguments, "restart", None)
    if restart is not None:
        from ..restart import joined_overrides, joined_plugins, kept_arguments

        name = (built_in_path(arguments.case) or Path(arguments.case)).stem
        kept, files = kept_arguments(name, arguments.output or Path("results", name), restart)
        overrides, plugins = joined_overrides(kept, overrides), joined_plugins(files, plugins)
    return Case.load(arguments.case, overrides, plugins=plugins)


def _command(arguments: argparse.Namespace, case: Case, ranks: int) -> str:
    """Return the shell command that continues this run."""
    launcher = ["srun" if "SLURM_STEP_NUM_TASKS" in os.environ else "mpirun", "-n", str(ranks)]
    words = [*(launcher if ranks > 1 else ()), *PROGRAM.split(), str(arguments.case)]
    words += ["-o", str(arguments.output)] if arguments.output is not None else []
    words += ["--quiet"] if arguments.quiet else []
    words += ["--wall-time", f"{arguments.wall_time:g}"] if arguments.wall_time is not None else []
    words += ["--plugin", *arguments.plugins] if arguments.plugins else []
    words += ["--set", *case.overrides] if case.overrides else []
    words += ["--restart"]
    words += ["--", *arguments.petsc_options] if arguments.petsc_options else []
    return shlex.join(words)


SWEEP = f"""\
examples:
  {PROGRAM} sweep rod_impact --vary time.step=0.005,0.01,0.02
  {PROGRAM} sweep my_case.toml --vary "initial.velocity=[1,0,0],[2,0,0]" --vary section.leg.area=1e-4,2e-4 --processes 4

exit status: 0 all runs are done, 3 some are not (see the column status of the table)"""


OF_SWEEP = (
    *CASE,
    argument(
        "--vary",
        metavar="KEY=VALUES",
        nargs="+",
        action="extend",
        required=True,
        help="values of a key, separated by commas; with several keys, all combinations",
    ),
    argument("-o", "--output", metavar="DIR", type=Path, help="output folder; default: results/NAME OF THE CASE-sweep"),
    argument("--processes", metavar="N", type=int, default=1, help="number of runs at a time; default: 1"),
    argument(
        "--results",
        metavar="NAME",
        nargs="+",
        help="columns of the history whose last values are in the table, named as for plot --curves; vectors have a "
        "column for each component, wall/floor/force.z is one of them; or columns of the table without this option, "
        "like peak_wall/floor/force",
    ),
    argument("--remove", action="store_true", help="remove the results of the runs, and keep the table only"),
    argument("--wall-time", metavar="TIME", type=seconds, help="stop a run after this time"),
    argument("--quiet", action="store_true", help="print no progress"),
)


def run_sweep(arguments: argparse.Namespace) -> int:
    """Make the runs, and print the table and the name of its file."""
    from ..case.schema import Case
    from ..studies import sweep

    vary: dict[str, list[Any]] = {}
    for key, values in map(_values, arguments.vary):
        if vary.setdefault(key, values) is not values:
            raise InputError(f"--vary {key}=...: given twice; give all its values in one list, {key}=VALUE,VALUE,VALUE")
    case = Case.load(arguments.case, arguments.overrides, plugins=arguments.plugins)
    output = arguments.output or Path("results") / f"{case.name}-sweep"
    table = sweep(
        case,
        vary,
        processes=arguments.processes,
        results={name: name for name in arguments.results} if arguments.results else None,
        output=output,
        keep=not arguments.remove,
        wall_time=arguments.wall_time,
        quiet=arguments.quiet,
    )
    print(printable(str(table)))
    print(output / "sweep.csv")
    return 3 if table["status"].any() else 0


def _values(text: str) -> tuple[str, list[Any]]:
    """Return key and values of ``KEY=VALUE,VALUE``; each value is TOML, or else plain text."""
    key, _, values = text.partition("=")
    found = _toml(f"[{values}]")
    if not values.strip() or found == []:
        raise InputError(f"--vary {text}: expected KEY=VALUES, like time.step=1e-5,2e-5")
    if found is not None:
        return key.strip(), found
    parts, begun = [], ""
    for piece in values.split(","):
        begun = f"{begun},{piece}" if begun else piece
        # a comma within a list, a table or a text in quotes divides no values
        if all(begun.count(a) == begun.count(b) for a, b in ("[]", "{}")) and begun.count('"') % 2 == 0:
            parts.append(begun.strip())
            begun = ""
    parts += [begun.strip()] if begun else []
    return key.strip(), [part if (value := _toml(part)) is None else value for part in parts]


def _toml(text: str) -> Any:
    """Return the value of a text, None if it is none."""
    try:
        (value,) = tomllib.loads(f"value = {text}").values()
    except (ValueError, RecursionError):  # also that of several keys
        return None
    return value


MESH = f"""\
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
OF_MESH = (
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


def run_mesh(arguments: argparse.Namespace) -> int:
    """Do what the subcommand says, and return the exit status."""
    from ..formats import writer_of
    from ..mesh.tools import cleaned, merged, refined, summary
    from ..output.table import aligned

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
            for path in arguments.inputs:
                lines = summary(_read(path, arguments.scale), arguments.tolerance)
                _tell([str(path), *aligned(lines)])
        case "picture":
            from ..post.page import mesh_page

            (mesh,), output = inputs(), arguments.output or arguments.input.with_suffix(".png")
            if output.suffix.lower() != ".png":
                raise InputError(f"{output}: a picture is written as .png")
            picture = mesh_page(mesh, arguments.size, arguments.view)
            with written(output, "the picture"):
                output.write_bytes(picture)
            _tell([str(output)])
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


CHECK = f"""\
examples:
  {PROGRAM} check my_case.toml --set time.step=1e-5
  {PROGRAM} check --env

exit status: 0 it can run, 2 invalid input, a first step that would fail, or something that runs need is missing here"""

LIST = f"""\
example:
  {PROGRAM} list"""

COMPLETION = f"""\
examples:
  source <({PROGRAM} completion bash)
  {PROGRAM} completion zsh > ~/.zsh/completions/_pfem-petsc

It completes the command pfem-petsc, and pfem where that is an alias: alias pfem='{PROGRAM}'"""

KINDS = {
    "integrators": "pfem_petsc.integrators",
    "mesh generators": "pfem_petsc.mesh.generators",
    "mesh formats": "pfem_petsc.formats",
    "material laws": "pfem_petsc.mechanics.materials",
    "walls": "pfem_petsc.contact.walls",
    "constraints": "pfem_petsc.contact.constraints",
    "treatments of impact": "pfem_petsc.contact.treatments",
    "methods of static analyses": "pfem_petsc.statics.methods",
}


OF_CHECK = (
    argument("case", **{**CASE[0].settings, "nargs": "?"}),
    CASE[1],
    argument(
        "--env",
        action="store_true",
        help="check this machine instead: versions, MPI, HDF5, PETSc, OpenGL, and how to install what is missing",
    ),
)


def check(arguments: argparse.Namespace, comm: MPI.Comm | None = None) -> int:
    """Build the simulation without a step, and print its summary. Collective."""
    if arguments.env:
        if arguments.case is not None or arguments.overrides:
            raise InputError("check --env checks the machine and takes no case: give one of the two")
        from .machine import inspect_environment, report

        found = inspect_environment()
        print("\n".join(printable(line) for line in report(found)))
        if missing := [each.name for each in found if each.state == "missing"]:
            raise InputError(
                f"check --env: missing: {', '.join(missing)}; the list above has the commands to install it"
            )
        print("This machine has everything that runs need.")
        return 0
    if arguments.case is None:
        raise InputError(
            f"the following arguments are required: CASE (give it before --set), or --env; see {PROGRAM} check --help"
        )
    case = load_case(arguments, comm)
    from ..output.table import aligned
    from ..simulation import Simulation

    simulation = Simulation(case, comm, check_only=True)
    summary = simulation.summary()
    closer, warnings = simulation.inspect()
    summary |= closer
    obstacle, notice = simulation.obstacle(), simulation.plan.scheme.notice
    if comm.rank == 0:
        lines = [printable(case.title), *aligned(summary.items())]
        lines += [f"warning: {text}" for text in warnings]
        lines += [f"note: {notice}"] if notice else []
        print("\n".join(lines if obstacle else [*lines, "This case can run."]))
    if obstacle:
        raise InputError(obstacle)
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    """Print the lists."""
    sections = {
        "built-in cases": {
            name: tomllib.loads(built_in_path(name).read_text(encoding="utf-8"))["title"] for name in built_in_cases()
        }
    }
    sections |= {kind: {n: description(package, n) for n in choices(package)} for kind, package in KINDS.items()}
    width = max(len(name) for lines in sections.values() for name in lines)
    for kind, lines in sections.items():
        print(f"{kind}:")
        if not lines:
            print("  none is built in; docs/extending.md has an example and says how to add one")
        for name, text in lines.items():
            print(f"  {name:{width}}  {text}")
    return 0


OF_COMPLETION = (argument("shell", choices=("bash", "zsh"), help="the shell"),)


def completion(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    parser, _ = make_parser()
    words = " ".join(f"{key}=" for key in sorted(set(keys())))
    preamble = {
        "bash": f'_pfem_keys() {{ compopt -o nospace; compgen -W "{words}" -- "$1"; }}',
        "zsh": f"_pfem_keys() {{ compadd -S '' -- {words} }}",
    }
    verbs = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction)).choices
    verbs |= dict.fromkeys(built_in_cases(), verbs["run"])
    fill(parser, (*OF_RUN, PLUGINS))
    for each in _parsers(parser):
        for action in each._actions:
            if action.dest in ("overrides", "vary"):
                action.complete = dict.fromkeys(preamble, "_pfem_keys")
            elif action.dest == "case":
                action.choices = built_in_cases()
            elif action.dest == "what":
                action.choices = [*choices("pfem_petsc.mesh.generators"), *built_in_cases()]
            elif action.choices is None and action.nargs != 0 and action.type is None:
                action.complete = shtab.FILE
    parser.prog = "pfem-petsc"
    script = shtab.complete(parser, arguments.shell, root_prefix="pfem", preamble=preamble)
    if arguments.shell == "bash":
        script += "\ncomplete -o bashdefault -F _shtab_pfem pfem"
    print(script.replace("#compdef pfem-petsc", "#compdef pfem-petsc pfem"))
    return 0


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from _parsers(each)


def keys() -> Iterator[str]:
    """Yield the keys of --set: of lists those of the first entry, of named tables those of the built-in cases."""
    from ..case.model import CaseModel, shape_of
    from ..case.schema import Case

    cases = [Case.load(name) for name in built_in_cases()]
    for table, field in CaseModel.model_fields.items():
        shape = shape_of(field)
        many, found = shape.many, shape.keys()
        names = {name for case in cases for name in case.__dict__[table]} if many is dict else ["0"] if many else []
        if not found:
            yield table
        yield from (".".join((table, name, key)) for name in names for key in found)
        yield from (f"{table}.{key}" for key in found if not many)


VERBS = (
    Verb("run", "Run a case (the default: CASE alone means run).", RUN, "all", OF_RUN, run_case),
    Verb(
        "sweep",
        "Run a case for all combinations of values of some keys, and write a table.",
        SWEEP,
        "one",
        OF_SWEEP,
        run_sweep,
    ),
    Verb(
        "mesh",
        "Generate, convert, inspect, draw, refine, merge and clean mesh files.",
        MESH,
        "one",
        (),
        run_mesh,
        OF_MESH,
    ),
    Verb(
        "list",
        "List the built-in cases, integrators, mesh generators and formats, walls, constraints, treatments, methods.",
        LIST,
        "one, without MPI",
        (),
        list_all,
    ),
    Verb(
        "check",
        "Check a case: read it, build its mesh and model, and summarise the run. Or, by --env, check this machine.",
        CHECK,
        # the check of a machine must not start an MPI that may be broken
        lambda arguments: "one, without MPI" if arguments.env else "all",
        OF_CHECK,
        check,
    ),
    Verb(
        "completion",
        "Print a script that completes verbs, options, built-in cases and keys of --set in a shell.",
        COMPLETION,
        "one, without MPI",
        OF_COMPLETION,
        completion,
    ),
)
