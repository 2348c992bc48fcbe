"""Signals that ask a run to stop, noted from the first moment of the program on.

Imports next to nothing: ``python -m pfem_petsc`` takes the signals over before it imports what takes a second.
"""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType

__all__ = ["SIGNALS", "SignalNotes", "early", "give_back_early", "watch_early"]

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)

_PATIENCE = 10.0  # seconds after which a third signal of any kind ends the process; batch systems may send two at once


class SignalNotes:
    """Takes note of signals, so that a run can end at the end of a step.

    The first and the second change nothing else. After the second one SIGINT has its default action again, and the
    others after some seconds: a third one ends the process at once, also inside of compiled code.
    """

    def __init__(self) -> None:
        self._signal = 0  # the first
        self._count = 0
        self._since = 0.0
        self._before: dict[int, object] = {}

    def watch(self) -> None:
        """Take the signals over. Nothing outside of the main thread, where Python cannot.

        A hang-up that is ignored, as under ``nohup``, stays ignored.
        """
        if threading.current_thread() is not threading.main_thread() or self._before:
            return
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._note)

    def release(self) -> None:
        """Give the signals back to who had them."""
        before, self._before = self._before, {}
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def adopt(self, other: SignalNotes) -> None:
        """Take over what another has noted."""
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
    """Note signals from now on, until :func:`give_back_early`."""
    _EARLY.watch()


def early() -> SignalNotes:
    """What was noted since :func:`watch_early`."""
    return _EARLY


def give_back_early() -> None:
    """For what has no step to stop after: signals do what they did before, also those that have come already.

    Raises
    ------
    KeyboardInterrupt
        When there was a SIGINT.
    """
    came = _EARLY._signal
    _EARLY.release()
    if came:
        signal.raise_signal(came)
