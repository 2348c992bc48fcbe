"""The errors that end a run, each with the exit status that the command line returns for it."""

from __future__ import annotations

__all__ = ["EarlyStop", "InputError", "NotConverged", "PfemError", "SimulationFailure", "printable"]


def printable(text: str) -> str:
    """A text without control characters but line breaks and tabs: a terminal would obey them."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


class PfemError(Exception):
    """A run cannot go on, and the message says why to the user.

    The message names what is wrong, where (file and key, or step, node and bar), the value, and the way out.
    """

    exit_status = 1


class InputError(PfemError):
    """Invalid input, found before the first step: case, mesh, restart file, option, unwritable output."""

    exit_status = 2


class SimulationFailure(PfemError):
    """The simulation failed on its way: no convergence, collapsed bar, instability, disk full."""

    exit_status = 3


class NotConverged(SimulationFailure):
    """A solve failed before anything of the state was changed: a smaller step may do. Raised on all ranks."""


class EarlyStop(PfemError):
    """The run stopped early on request (signal or time limit), with a checkpoint written."""

    exit_status = 4
