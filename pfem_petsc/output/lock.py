"""The lock of an output folder: only one run at a time writes into it.

A file beside the folder, ``NAME.lock``, identifies the owner: machine, process, and start time of that process. It is
created by a hard link, which is atomic on network file systems too, or by exclusive creation if there are no hard
links. A killed run leaves its file behind. On the same machine, process number and start time show that it has ended,
and the next run takes the lock over. On another machine only the time of the last renewal is known: a lock not renewed
for an hour is taken over, a more recent one is respected.
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
ABANDONED = 3600.0  # seconds without renewal after which a lock of another machine counts as abandoned
_UNFINISHED = 5.0  # seconds in which a file made by exclusive creation must get its content
_ATTEMPTS = 200


class FolderLock:
    """The lock of one output folder, held by one process (rank 0 of a run).

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    path : Path
        The lock file.
    """

    def __init__(self, folder: Path) -> None:
        if "\0" in str(folder):
            raise InputError(f"the name of the output folder {str(folder)!r} contains a NUL character")
        folder = folder.resolve()
        self.folder = folder
        beside = folder.parent
        while not beside.exists():
            beside = beside.parent
        self._beside = beside
        # if the user can write only into the folder itself, the folder cannot be moved aside either
        inside = folder.is_dir() and not os.access(beside, os.W_OK | os.X_OK)
        self.path = folder / "run.lock" if inside or not folder.name else folder.with_name(folder.name + ".lock")
        self._token: str | None = None
        self._renewed = 0.0

    @property
    def held(self) -> bool:
        """Whether this object holds the lock."""
        return self._token is not None

    def check(self) -> None:
        """Refuse a folder that another run has locked, or that cannot be made, without taking the lock.

        Raises
        ------
        InputError
        """
        if not self._beside.is_dir():
            raise InputError(
                f"{self.folder}: cannot write the results there: {self._beside} is no folder; choose another with -o"
            )
        owner = _read(self.path)
        if owner is not None and not _abandoned(self.path, owner):
            self._refuse(owner)

    def take(self) -> None:
        """Take the lock.

        Raises
        ------
        InputError
            If another run holds it, or its file cannot be written.
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
        raise InputError(f"{self.folder}: its lock {self.path} changes repeatedly; choose another folder with -o")

    def renew(self) -> None:
        """Renew the lock if the renewal interval has elapsed; otherwise this only reads the clock.

        Raises
        ------
        SimulationFailure
            If this run no longer holds the lock.
        """
        if self._token is None or time.monotonic() - self._renewed < RENEWAL:
            return
        self._renewed = time.monotonic()
        with contextlib.suppress(OSError):
            owner = _read(self.path)
            if owner == {}:  # temporarily unreadable
                return
            if owner is None or owner.get("token") != self._token:
                self._token = None
                raise SimulationFailure(
                    f"{self.path}: the lock of the output folder was removed or taken over by another run: this one "
                    "stops before both write into it; continue with --restart when the other has ended"
                )
            os.utime(self.path)

    def release(self) -> None:
        """Release the lock if it is held."""
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
                f"; it renewed its lock {duration(_age(self.path))} ago: if it is dead, remove {self.path}; this "
                f"happens automatically after {duration(ABANDONED)}"
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
    """Return the scope of process numbers: a machine since its last boot, and a container on it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _start_time(pid: int) -> str | None:
    """Return the start time of a process in ticks since boot; None if it has ended, "" if unknown."""
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
    """Return whether the run that created this lock has certainly ended."""
    if not owner:  # no content: its owner was killed, or is about to write it
        return _age(path) > _UNFINISHED
    if _is_here(owner) and isinstance(owner.get("pid"), int):
        return _start_time(owner["pid"]) != owner.get("start")
    return _age(path) > ABANDONED


def _age(path: Path) -> float:
    """Return the seconds since a file was renewed, by the clock of its file system."""
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
    """Return the owner of a lock: None for nobody, empty if the file has no valid content."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _beside(path: Path) -> Path:
    """Return a unique name beside a path."""
    return path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex[:12]}")


def _create(path: Path, content: dict[str, Any]) -> bool:
    """Create a lock with its content atomically; return False if it exists."""
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
            # a network file system may have created the link and lost the reply
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
    """Remove an abandoned lock; of several processes, one at a time checks again and removes it.

    Thus no process removes a lock that another one has just taken instead.
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
