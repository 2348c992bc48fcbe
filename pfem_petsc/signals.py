"""Signals that request a run to stop, recorded from the start of the program, its launcher, and the end of the program.

Imports very little: ``python -m pfem_petsc`` installs the handlers before the other imports, which take a second.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import TextIO

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)

OF_A_LAUNCH = (
    *("PMIX_", "PMI_", "OPAL_", "ORTE_", "PRTE_LAUNCHED", "OMPI_COMM_", "OMPI_APP_", "OMPI_UNIVERSE_", "OMPI_FILE_"),
    *("OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix", "HYDRA_", "MPI_LOCALRANKID", "SLURM_PROCID", "SLURM_PMI"),
    "PALS_",
)
"""Variables that a launcher of MPI sets, and that would make another process a rank of the same job."""


def launched_rank() -> int | None:
    """Return the rank of this process according to its launcher, None without a launcher."""
    names = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK", "SLURM_PROCID")
    return next((int(os.environ[name]) for name in names if os.environ.get(name, "").isdigit()), None)


def environment_alone() -> dict[str, str]:
    """Return the environment of processes that MPI does not launch."""
    return {name: value for name, value in os.environ.items() if not name.startswith(OF_A_LAUNCH)}


_PATIENCE = 10.0  # seconds after which a third signal of any kind ends the process; batch systems may send two at once


class SignalNotes:
    """Records signals, so that a run can stop at the end of a step.

    The first and the second signal are only recorded. After the second one SIGINT has its default action again, and the
    others after some seconds: a third one ends the process at once, even inside compiled code.
    """

    def __init__(self) -> None:
        self._signal = 0  # the first
        self._count = 0
        self._since = 0.0
        self._before: dict[int, object] = {}

    def watch(self) -> None:
        """Install the signal handlers, in the main thread only, as Python requires.

        An ignored hang-up signal, as under ``nohup``, remains ignored.
        """
        if threading.current_thread() is not threading.main_thread() or self._before:
            return
        for number in SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
                signal.signal(number, signal.SIG_IGN)  # a library may have installed its own handler below Python
            else:
                self._before[number] = signal.signal(number, self._note)

    def keep_watching(self) -> None:
        """Install the handlers again, below Python, after a library may have installed its own there. Python ignores
        broken pipes, so that writing to one raises an error."""
        for number in (*SIGNALS, signal.SIGPIPE):
            if (handler := signal.getsignal(number)) is not None:
                signal.signal(number, handler)

    def release(self) -> None:
        """Restore the previous signal handlers."""
        before, self._before = self._before, {}
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def adopt(self, other: SignalNotes) -> None:
        """Adopt the signals that another object has recorded."""
        if other._signal and not self._signal:
            self._signal, self._count, self._since = other._signal, other._count, other._since

    def _note(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if not self._signal:
            self._signal, self._since = number, now
        self._count += 1
        if self._count > 1 and (number == signal.SIGINT or now - self._since > _PATIENCE):
            signal.signal(number, signal.SIG_DFL)


_EARLY = SignalNotes()


def watch_early() -> None:
    """Record signals from now on, until :func:`give_back_early`."""
    _EARLY.watch()


def early() -> SignalNotes:
    """Return the signals recorded since :func:`watch_early`."""
    return _EARLY


def give_back_early() -> None:
    """Restore the previous handlers for commands without steps, and deliver signals that were recorded.

    Raises
    ------
    KeyboardInterrupt
        If there was a SIGINT.
    """
    came = _EARLY._signal
    _EARLY.release()
    if came:
        signal.raise_signal(came)


class Leaving:
    """Ends the process at exit once all other work at exit is done.

    Python would then free, one by one, objects and libraries that end with the process anyway. A program that has
    failed, or that has left files open, ends in the usual way.

    Attributes
    ----------
    status : exit status of the program; None until it is known
    """

    status: int | None = None

    def ends_with(self, status: int) -> int:
        """Take the exit status of the program, which has nothing more to do, and return it."""
        self.status = status
        if status == 0:
            gc.freeze()  # nothing that is collected at exit would be freed for long
        return status

    def leave(self) -> None:
        """End the process if the program has succeeded."""
        if self.status != 0:
            return
        if not _files_are_open() and _are_flushed(sys.stdout, sys.stderr):
            _finalise()
            os._exit(0)
        gc.unfreeze()
        gc.collect()  # objects that libraries could no longer free after Python


def leave_at_exit() -> Leaving:
    """Return what ends the process after everything that is registered from now on for the exit."""
    leaving = Leaving()
    atexit.register(leaving.leave)
    return leaving


def _finalise() -> None:
    """Finalise libraries in the order in which they end with the interpreter: PETSc prints its logs, then MPI tells the
    launcher."""
    if "petsc4py.PETSc" in sys.modules:
        sys.modules["petsc4py.PETSc"]._finalize()
    if "mpi4py.MPI" in sys.modules:
        mpi = sys.modules["mpi4py.MPI"]
        if mpi.Is_initialized() and not mpi.Is_finalized():
            mpi.Finalize()
    ctypes.CDLL(None).fflush(None)  # what libraries have printed


def _are_flushed(*streams: TextIO) -> bool:
    """Return whether all is written; what is not, Python reports with the exit status of that."""
    try:
        for stream in streams:
            stream.flush()
    except (OSError, ValueError):
        return False
    return True


def _files_are_open() -> bool:
    """Return whether files of HDF5 are open, which it would complete at the end of the process."""
    h5py = sys.modules.get("h5py")
    return h5py is not None and h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) > 0
