"""Check a case: read it, build its mesh and model, and summarise the run. Or, by --env, check this machine."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..errors import InputError, printable
from .parser import PROGRAM, add_case, add_plugins
from .run import load_case

if TYPE_CHECKING:
    from mpi4py import MPI

RANKS = "all"

EXAMPLE = f"""\
examples:
  {PROGRAM} check my_case.toml --set time.step=1e-5
  {PROGRAM} check --env

exit status: 0 it can run, 2 invalid input, or something that runs need is missing here"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_case(parser, optional=True)
    add_plugins(parser)
    parser.add_argument(
        "--env",
        action="store_true",
        help="check this machine instead: versions, MPI, HDF5, PETSc, OpenGL, and how to install what is missing",
    )


def ranks(arguments: argparse.Namespace) -> str:
    """Return which ranks the verb needs: the check of a machine must not start an MPI that may be broken."""
    return "one, without MPI" if arguments.env else RANKS


def run(arguments: argparse.Namespace, comm: MPI.Comm | None = None) -> int:
    """Build the simulation without a step, and print its summary. Collective."""
    if arguments.env:
        if arguments.case is not None or arguments.overrides:
            raise InputError("check --env checks the machine and takes no case: give one of the two")
        return _check_machine()
    if arguments.case is None:
        raise InputError(
            f"the following arguments are required: CASE (give it before --set), or --env; see {PROGRAM} check --help"
        )
    case = load_case(arguments, comm)
    from ..simulation import Simulation

    simulation = Simulation(case, comm, check_only=True)
    summary = simulation.summary()
    closer, warnings = simulation.inspect()
    summary |= closer
    obstacle, notice = simulation.obstacle(), simulation.plan.scheme.notice
    if comm.rank == 0:
        width = max(map(len, summary), default=0)
        lines = [printable(case.title), *(f"  {label:{width}}  {text}" for label, text in summary.items())]
        lines += [f"warning: {text}" for text in warnings]
        lines += [f"note: {notice}"] if notice else []
        print("\n".join(lines if obstacle else [*lines, "This case can run."]))
    if obstacle:
        raise InputError(obstacle)
    return 0


def _check_machine() -> int:
    from .environment import inspect_environment, report

    found = inspect_environment()
    print("\n".join(printable(line) for line in report(found)))
    missing = [each.name for each in found if each.state == "missing"]
    if missing:
        raise InputError(f"check --env: missing: {', '.join(missing)}; the list above has the commands to install it")
    print("This machine has everything that runs need.")
    return 0
