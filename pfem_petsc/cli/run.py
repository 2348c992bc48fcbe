"""Run a case (the default: CASE alone means run)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import PROGRAM, add_case, seconds

if TYPE_CHECKING:
    from mpi4py import MPI

RANKS = "all"

EXAMPLE = f"""\
examples:
  mpirun -n 2 {PROGRAM} rod_impact
  mpirun -n 2 {PROGRAM} my_case.toml -o results/fine --set time.step=1e-5 mesh.elements=100
  mpirun -n 2 {PROGRAM} my_case.toml --restart
  mpirun -n 2 {PROGRAM} my_case.toml -- -log_view

exit status: 0 done, 2 invalid input, 3 the simulation failed, 4 stopped early with a checkpoint"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_case(parser)
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="output folder; default: results/NAME OF THE CASE"
    )
    parser.add_argument(
        "--restart",
        metavar="FILE",
        nargs="?",
        const=True,
        help="go on from a checkpoint; default: the newest of the output folder",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on the screen")
    parser.add_argument(
        "--wall-time",
        metavar="TIME",
        type=seconds,
        help="stop with a checkpoint after this time: seconds, or hours:minutes:seconds",
    )


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Simulate, and give the exit status. Collective."""
    case = load_case(arguments, comm)
    from ..simulation import Simulation

    restart = arguments.restart if arguments.restart in (None, True) else Path(arguments.restart)
    simulation = Simulation(
        case,
        comm,
        output=arguments.output or Path("results", case.name),
        restart=restart,
        quiet=arguments.quiet,
        wall_time=arguments.wall_time,
    )
    return simulation.run() or 0


def load_case(arguments: argparse.Namespace, comm: MPI.Comm):  # noqa: ANN201 - the type would import the schema
    """The case of the command line, read by rank 0; PETSc is started with its options. Collective."""
    import petsc4py

    petsc4py.init([PROGRAM, *arguments.petsc_options])
    from ..case.schema import Case
    from ..parallel.agreement import on_root

    return on_root(comm, Case.load, arguments.case, arguments.overrides)
