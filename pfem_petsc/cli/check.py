"""Check a case: read it, build its mesh and model, and summarise the run."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..errors import printable
from .parser import PROGRAM, add_case
from .run import load_case

if TYPE_CHECKING:
    from mpi4py import MPI

RANKS = "all"

EXAMPLE = f"""\
example:
  {PROGRAM} check my_case.toml --set time.step=1e-5

exit status: 0 it can run, 2 invalid input"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add_case(parser)


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Build the simulation without a step, and print its summary. Collective."""
    case = load_case(arguments, comm)
    from ..simulation import Simulation

    simulation = Simulation(case, comm, check_only=True)
    summary = simulation.summary()
    closer, warnings = simulation.inspect()
    summary |= closer
    if comm.rank == 0:
        width = max(map(len, summary), default=0)
        print(printable(case.title))
        for label, text in summary.items():
            print(f"  {label:{width}}  {text}")
        for text in warnings:
            print(f"warning: {text}")
        if simulation.plan.scheme.notice:
            print(f"note: {simulation.plan.scheme.notice}")
        print("This case can run.")
    return 0
