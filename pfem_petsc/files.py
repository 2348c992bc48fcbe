"""Sizes and kinds of files that are read whole, and the memory that bounds them; folders that are moved aside."""

from __future__ import annotations

import errno
import itertools
import os
import stat
import zipfile
from pathlib import Path

__all__ = ["check_contents", "memory_of_machine", "move_aside", "readable_whole"]


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
