"""Files that are read whole, and the memory that bounds them; folders moved aside; the lock of an output folder.

Only one run at a time writes into an output folder. A file beside it, ``NAME.lock``, identifies the owner: machine,
process, and start time of that process. It is created exclusively, which network file systems do atomically too, and
then gets its content. A killed run leaves its file behind: on the same machine, process number and start time show that
it has ended, and the next run takes the lock over. Nothing is known of processes on other machines: their locks are
respected until somebody removes the file.
"""

from __future__ import annotations

import errno
import fcntl
import itertools
import json
import os
import socket
import stat
import time
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .errors import InputError, SimulationFailure

__all__ = ["FolderLock", "check_contents", "memory_of_machine", "move_aside", "readable_whole"]


def memory_of_machine() -> float:
    """Return the memory of this machine, or of the container of this process [B]."""
    found = [float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")]
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            text = Path(path).read_text().strip()
        except OSError:
            continue
        if text.isdigit():
            found.append(float(text))
    return min(found)


def readable_whole(path: Path) -> Path:
    """Return a path if it can be read to its end: it is no pipe or device, and not larger than the memory.

    Raises
    ------
    OSError
        As for a file that cannot be opened.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name contains a NUL character")
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        raise OSError(errno.EINVAL, "it is no regular file but a pipe, socket or device")
    _check(found.st_size)
    return path


def check_contents(archive: zipfile.ZipFile) -> None:
    """Check that the memory holds the uncompressed files of an archive.

    Raises
    ------
    OSError
    """
    _check(sum(entry.file_size for entry in archive.infolist()))


def _check(size: int) -> None:
    memory = memory_of_machine()
    if size > memory:
        raise OSError(
            errno.EFBIG, f"it has {size / 1e9:,.1f} GB of content, more than the memory of {memory / 1e9:,.1f} GB"
        )


def move_aside(folder: Path) -> Path:
    """Give a folder the next free numbered name, ``NAME.1``; return it."""
    names = (folder.with_name(f"{folder.name}.{number}") for number in itertools.count(1))
    return folder.rename(next(name for name in names if not name.exists()))


INTERVAL = 30.0  # seconds between checks that the lock is still held
_UNFINISHED = 5.0  # seconds in which a file that was created must get its content


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
        self._beside = next(parent for parent in folder.parents or (folder,) if parent.exists())
        # if the user can write only into the folder itself, the folder cannot be moved aside either
        inside = folder.is_dir() and not os.access(self._beside, os.W_OK | os.X_OK)
        self.path = folder / "run.lock" if inside or not folder.name else folder.with_name(folder.name + ".lock")
        self._token: str | None = None
        self._checked = 0.0

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
        self._refuse(_owner_of(self.path))

    def take(self) -> None:
        """Take the lock.

        Raises
        ------
        InputError
            If another run holds it, or its file cannot be written.
        """
        if self._token is not None:
            return
        mine = _identity()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with _one_at_a_time(self.path.parent):
                while not _made(self.path, mine):
                    owner = _owner_of(self.path)
                    self._refuse(owner)
                    if owner is not None:
                        self.path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder}: cannot write the results there: {error.strerror} ({self.path}); choose another with -o"
            ) from error
        self._token, self._checked = mine["token"], time.monotonic()

    def renew(self) -> None:
        """Look every 30 s whether this run still holds the lock; otherwise this only reads the clock.

        Raises
        ------
        SimulationFailure
            If it does not.
        """
        if self._token is None or time.monotonic() - self._checked < INTERVAL:
            return
        self._checked = time.monotonic()
        owner = _owner_of(self.path)
        if owner is None or owner.get("token", self._token) != self._token:  # {}: temporarily unreadable
            self._token = None
            raise SimulationFailure(
                f"{self.path}: the lock of the output folder was removed or taken over by another run: this one "
                "stops before both write into it; continue with --restart when the other has ended"
            )

    def release(self) -> None:
        """Release the lock if it is held."""
        token, self._token = self._token, None
        if token is not None and (_owner_of(self.path) or {}).get("token") == token:
            with suppress(OSError):
                self.path.unlink()

    def _refuse(self, owner: dict[str, Any] | None) -> None:
        """Refuse a folder whose lock has an owner that may be alive."""
        if owner is None or _has_ended(self.path, owner):
            return
        if not owner:
            raise InputError(
                f"{self.folder}: another run is about to write into this folder, or {self.path} is no lock of this "
                "program: try again in some seconds, remove that file, or choose another folder with -o"
            )
        who = f"process {owner['pid']} on {owner['host']}, since {owner['since']}"
        remedy = "wait until it has ended, stop it (SIGTERM), or choose another folder with -o"
        if owner["machine"] != _machine():
            remedy += f"; if it was killed there, or that machine has restarted, remove {self.path}"
        raise InputError(f"{self.folder}: another run is writing into this folder: {who}; {remedy}")


def _identity() -> dict[str, Any]:
    return {
        "host": socket.gethostname(),
        "machine": _machine(),
        "pid": os.getpid(),
        "start": _start_time(os.getpid()),
        "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        "token": uuid.uuid4().hex,
    }


def _machine() -> str:
    """Return the scope of process numbers: a machine since its last boot, and a container on it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return socket.gethostname()


def _start_time(pid: int) -> str | None:
    """Return the start time of a process in ticks since boot; None if it has ended, "" if unknown."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    # a zombie has ended
    return None if fields[0] in (b"Z", b"X") else fields[19].decode()


def _has_ended(path: Path, owner: dict[str, Any]) -> bool:
    """Return whether the run that created this lock has certainly ended."""
    if not owner:  # no content: its owner was killed, or is about to write it
        with suppress(OSError):
            return time.time() - path.stat().st_mtime > _UNFINISHED
        return False
    return owner["machine"] == _machine() and _start_time(owner["pid"]) != owner["start"]


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Context that processes of this machine enter one at a time, so that none removes a lock just taken by another.

    Only locks of this machine are removed. File systems without ``flock`` for folders do without.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _owner_of(path: Path) -> dict[str, Any] | None:
    """Return the owner of a lock: None for nobody, empty if the file has no valid content."""
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and content.keys() >= _identity().keys() else {}


def _made(path: Path, content: dict[str, Any]) -> bool:
    """Create a lock with its content; return False if it exists."""
    try:
        with path.open("xb") as file:
            file.write(json.dumps(content).encode())
    except FileExistsError:
        return False
    return True
