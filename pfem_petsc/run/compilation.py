"""Messages of a run about the compilation of loops."""

from __future__ import annotations

from mpi4py import MPI

from ..mechanics.compiled import Compilation
from ..output.progress import Progress

__all__ = ["ReportedCompilation"]


_PATIENCE = 2.0
"""Time [s] of compilations up to which nothing is said."""


class ReportedCompilation(Compilation):
    """Reports once that loops are compiled, if that takes long, and excludes the time from the rate of steps.

    Attributes
    ----------
    progress : the progress report of the run; None before it is open, when rank 0 prints unless it is quiet
    """

    def __init__(self, comm: MPI.Comm, quiet: bool) -> None:
        super().__init__(self._tell, self._leave_out, _PATIENCE)
        self.progress: Progress | None = None
        self._speaks = comm.rank == 0 and not quiet

    def _tell(self, name: str) -> None:
        text = (
            f"compiling loops for this machine (once, up to a minute in total): {name}, and others that this kind of "
            "case needs; later runs load them"
        )
        if self.progress is not None:
            self.progress.message(text)
        elif self._speaks:
            print(text, flush=True)

    def _leave_out(self, seconds: float) -> None:
        if self.progress is not None:
            self.progress.compiled(seconds)
