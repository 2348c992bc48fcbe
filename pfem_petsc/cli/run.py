"""Run a case (the default: CASE alone means run)."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EarlyStop, SimulationFailure
from .parser import CASE, PLUGINS, PROGRAM, Verb, argument, seconds, start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..case.schema import Case

EXAMPLE = f"""\
examples:
  mpirun -n 2 {PROGRAM} rod_impact
  mpirun -n 2 {PROGRAM} my_case.toml -o results/fine --set time.step=1e-5 mesh.elements=100
  mpirun -n 2 {PROGRAM} my_case.toml --restart
  mpirun -n 2 {PROGRAM} my_case.toml -- -log_view

exit status: 0 done, 2 invalid input, 3 the simulation failed, 4 stopped early with a checkpoint"""


ARGUMENTS = (
    *CASE,
    PLUGINS,
    argument("-o", "--output", metavar="DIR", type=Path, help="output folder; default: results/NAME OF THE CASE"),
    argument(
        "--restart",
        metavar="FILE",
        nargs="?",
        const=True,
        help="continue from a checkpoint, or the newest of a folder; default: of the output folder; earlier "
        "--set values stay in force",
    ),
    argument("--quiet", action="store_true", help="print no progress"),
    argument(
        "--wall-time",
        metavar="TIME",
        type=seconds,
        help="stop with a checkpoint after this time: seconds, or hours:minutes:seconds",
    ),
)


def run(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Simulate, and return the exit status. Collective."""
    restart = arguments.restart if arguments.restart in (None, True) else Path(arguments.restart)
    case = load_case(arguments, comm)
    output = arguments.output or Path("results", case.name)
    from ..simulation import Simulation

    command = _command(arguments, case, comm.size)
    try:
        with Simulation(
            case, comm, output=output, restart=restart, quiet=arguments.quiet, wall_time=arguments.wall_time
        ) as simulation:
            kept = [text for text in case.overrides if text not in arguments.overrides]
            if kept:
                simulation.notes.append(f"as in the run that is continued: --set {shlex.join(kept)}")
            return simulation.run() or 0
    except (EarlyStop, SimulationFailure) as error:
        if "continue with --restart" in str(error):
            raise type(error)(f"{error}\n  {command}") from error
        raise


def load_case(arguments: argparse.Namespace, comm: MPI.Comm) -> Case:
    """Return the case of the command line, read by rank 0; start PETSc with its options. Collective.

    A restart applies the ``--set`` values of the continued run, overridden by those given now.
    """
    start_petsc(arguments.petsc_options, comm.rank)
    from ..parallel.agreement import on_root

    return on_root(comm, _load, arguments)


def _load(arguments: argparse.Namespace) -> Case:
    from ..case.schema import Case
    from ..case.toml import built_in_path

    overrides = arguments.overrides
    restart = getattr(arguments, "restart", None)
    if restart is not None:
        from ..restart.checkpoints import joined_overrides, kept_overrides

        name = (built_in_path(arguments.case) or Path(arguments.case)).stem
        kept = kept_overrides(name, arguments.output or Path("results", name), restart)
        overrides = joined_overrides(kept, overrides)
    return Case.load(arguments.case, overrides, plugins=arguments.plugins)


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


VERBS = (Verb("run", str(__doc__), EXAMPLE, "all", ARGUMENTS, run),)
