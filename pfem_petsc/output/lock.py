"""The lock of an output folder: one run at a time writes into it.

A file beside the folder, ``NAME.lock``, says who has it: machine, process, and when that process started. It is made
by a hard link, which is atomic on network file systems too; where there are none, by exclusive creation. A run that is
killed leaves its file behind. On the machine that it ran on, the process number and its start time tell that it has
ended, and the next run takes the lock over. From another machine nothing can be told but how long ago the owner has
last renewed the file: one that is older than an hour is taken over, a younger one is refused.
"""

from __future__ import annotations

import contextlib
import getpass
import json
import os
import socket
import time
import uuid
from pathlib import Path
from typing import Any

from ..errors import InputError, SimulationFailure
from .units import duration

__all__ = ["FolderLock"]

RENEWAL = 30.0  # seconds between renewals
ABANDONED = 3600.0  # seconds without renewal after which a lock of another machine counts as left behind
_UNFINISHED = 5.0  # seconds in which a file made by exclusive creation gets its content
_ATTEMPTS = 200


class FolderLock:
    """The right to write into one output folder, for one process (rank 0 of a run).

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    path : Path
        The file of the lock.
    """

    def __init__(self, folder: Path) -> None:
        folder = folder.resolve()
        self.folder = folder
        beside = folder.parent
        while not beside.exists():
            beside = beside.parent
        # where the folder is all that this user can write to, the folder cannot be moved aside either
        inside = folder.is_dir() and not os.access(beside, os.W_OK | os.X_OK)
        self.path = folder / "run.lock" if inside or not folder.name else folder.with_name(folder.name + ".lock")
        self._token: str | None = None
        self._renewed = 0.0

    @property
    def held(self) -> bool:
        """Whether this object has the lock."""
        return self._token is not None

    def check(self) -> None:
        """Refuse a folder that another run has now, without taking it.

        Raises
        ------
        InputError
        """
        owner = _read(self.path)
        if owner is not None and not _abandoned(self.path, owner):
            self._refuse(owner)

    def take(self) -> None:
        """Take the lock.

        Raises
        ------
        InputError
            Another run has it, or its file cannot be written.
        """
        if self.held:
            return
        mine = _identity()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            for _ in range(_ATTEMPTS):
                if _create(self.path, mine):
                    self._token, self._renewed = mine["token"], time.monotonic()
                    return
                owner = _read(self.path)
                if owner is None:
                    continue
                if not _abandoned(self.path, owner):
                    self._refuse(owner)
                _remove_abandoned(self.path)
        except OSError as error:
            raise InputError(
                f"{self.folder}: cannot write the results there: {error.strerror} ({self.path}); choose another with -o"
            ) from error
        raise InputError(f"{self.folder}: its lock {self.path} changes all the time; choose another folder with -o")

    def renew(self) -> None:
        """Show that the owner is alive, from time to time; costs a look at the clock between.

        Raises
        ------
        SimulationFailure
            The lock is no longer this run's.
        """
        if self._token is None or time.monotonic() - self._renewed < RENEWAL:
            return
        self._renewed = time.monotonic()
        with contextlib.suppress(OSError):
            owner = _read(self.path)
            if owner == {}:  # unreadable for the moment
                return
            if owner is None or owner.get("token") != self._token:
                self._token = None
                raise SimulationFailure(
                    f"{self.path}: the lock of the output folder was removed or taken over by another run: this one "
                    "stops before both write into it; continue with --restart when the other has ended"
                )
            os.utime(self.path)

    def release(self) -> None:
        """Give the lock back; without it: nothing."""
        token, self._token = self._token, None
        if token is None:
            return
        with contextlib.suppress(OSError):
            owner = _read(self.path)
            if owner is not None and owner.get("token") == token:
                self.path.unlink()

    def _refuse(self, owner: dict[str, Any]) -> None:
        who = f"process {owner.get('pid', '?')} on {owner.get('host', '?')}"
        if owner.get("user"):
            who += f" of {owner['user']}"
        if owner.get("since"):
            who += f", since {owner['since']}"
        way = "wait until it has ended, stop it (SIGTERM), or choose another folder with -o"
        if not _is_here(owner):
            way += (
                f"; it has shown itself {duration(_age(self.path))} ago: if it is dead, remove {self.path}, which is "
                f"done without asking after {duration(ABANDONED)}"
            )
        raise InputError(f"{self.folder}: another run is writing into this folder: {who}; {way}")


def _identity() -> dict[str, Any]:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = ""
    return {
        "host": socket.gethostname(),
        "machine": _machine(),
        "pid": os.getpid(),
        "start": _start_time(os.getpid()),
        "user": user,
        "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        "token": uuid.uuid4().hex,
    }


def _machine() -> str:
    """The space in which a process number means a process: a machine since its last start, a container of it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _start_time(pid: int) -> str | None:
    """When a process started, in ticks since the machine did; None where it is gone, "" where that is not known."""
    if not Path("/proc/self/stat").exists():
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return None
        except OSError:
            pass
        return ""
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    # a zombie has ended
    return None if fields[0] in (b"Z", b"X") else fields[19].decode()


def _is_here(owner: dict[str, Any]) -> bool:
    return owner.get("host") == socket.gethostname() and owner.get("machine") == _machine()


def _abandoned(path: Path, owner: dict[str, Any]) -> bool:
    """Whether the run that made this lock has certainly ended."""
    if not owner:  # no content: its maker was killed, or is just about to write it
        return _age(path) > _UNFINISHED
    if _is_here(owner) and isinstance(owner.get("pid"), int):
        return _start_time(owner["pid"]) != owner.get("start")
    return _age(path) > ABANDONED


def _age(path: Path) -> float:
    """Seconds since a file was renewed, by the clock of its file system."""
    probe = _beside(path)
    try:
        probe.touch()
        return probe.stat().st_mtime - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0
    except OSError:
        return time.time() - path.stat().st_mtime if path.exists() else 0.0
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()


def _read(path: Path) -> dict[str, Any] | None:
    """Who has a lock: None for nobody, empty where the file does not say."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _beside(path: Path) -> Path:
    """A name that nobody else has."""
    return path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex[:12]}")


def _create(path: Path, content: dict[str, Any]) -> bool:
    """Make a lock with its content, at once and by one process alone; False where there is one."""
    raw = json.dumps(content).encode()
    temporary = _beside(path)
    try:
        with temporary.open("xb") as file:
            file.write(raw)
        try:
            os.link(temporary, path)
            return True
        except FileExistsError:
            return False
        except OSError:
            # a network file system may have made the link and lost the answer
            if temporary.stat().st_nlink == 2:
                return True
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    try:
        with path.open("xb") as file:  # a file system without hard links
            file.write(raw)
        return True
    except FileExistsError:
        return False


def _remove_abandoned(path: Path) -> None:
    """Remove a lock that was left behind; of several processes that want to, one at a time looks again and does it.

    So nobody removes the lock that another has just taken in its place.
    """
    guard = path.with_name(path.name + ".broken")
    mine = _identity()
    if not _create(guard, mine):
        owner = _read(guard)
        if owner is not None and _abandoned(guard, owner):
            guard.unlink(missing_ok=True)
        time.sleep(0.02)
        return
    try:
        owner = _read(path)
        if owner is not None and _abandoned(path, owner):
            path.unlink(missing_ok=True)
    finally:
        guard.unlink(missing_ok=True)
