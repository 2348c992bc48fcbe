"""Integrity of checkpoints: checksums of the arrays, and a seal over everything else in the file.

HDF5 checks little of what it reads, and a damaged file can crash it. Therefore the bytes that it would parse are
compared with a digest before it opens the file. Digest, format and version are stored in the user block of the file, a
text at its beginning that HDF5 skips. Array values have their own checksums, which the ranks compute together.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from mpi4py import MPI

from ..errors import InputError

__all__ = ["check_seal", "checksum", "remedy", "seal", "seal_size", "word_sum"]

FORMAT, VERSION = "pfem_petsc checkpoint", 1
LARGEST_SEAL = 1 << 20
# Number of words summed, or of bytes read, at a time.
BLOCK = 1 << 18
# Number of words from which a compiled loop sums them.
COMPILED = 1 << 12


def checksum(comm: MPI.Comm, slab: np.ndarray, first: int) -> int:
    """Return the checksum of an array distributed in slabs, the same for any number of ranks. Collective.

    It is the sum, modulo 2^64, of all numbers as unsigned words, each times an odd factor computed from its index. It
    detects a change of any single number, and numbers that are swapped.

    Parameters
    ----------
    comm : MPI.Comm
    slab : (n, ...)
        Numbers of 1, 2, 4 or 8 bytes.
    first : int
        Global index of the first row of the slab.
    """
    total = np.array([word_sum(slab, first)], dtype=np.uint64)
    comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    return int(total[0])


def word_sum(slab: np.ndarray, first: int) -> int:
    """Return this process's part of :func:`checksum`; the parts add up, modulo 2^64, to the checksum of the whole."""
    words = np.ascontiguousarray(slab).reshape(-1).view(f"u{slab.dtype.itemsize}")
    start = first * int(np.prod(slab.shape[1:], dtype=np.int64))
    if len(words) >= COMPILED:
        # those that read results need no compiled loops, which take a third of a second to load
        from .word_sums import sum_of_words

        return int(sum_of_words(words, start))
    total = np.zeros(1, dtype=np.uint64)
    for i in range(0, len(words), BLOCK):
        block = words[i : i + BLOCK].astype(np.uint64)
        index = np.arange(start + i, start + i + len(block), dtype=np.uint64)
        factor = (index + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        factor ^= factor >> np.uint64(29)
        total += np.sum(block * (factor | np.uint64(1)), dtype=np.uint64)
    return int(total[0])


def seal_size(n_arrays: int) -> int:
    """Return the size of the user block for the seal of a file with ``n_arrays``: a power of two, as HDF5 requires."""
    return 1 << (511 + 64 * n_arrays).bit_length()


def seal(path: Path) -> None:
    """Write the seal into the user block of a complete, closed file. Not collective."""
    with h5py.File(path, "r", locking=False) as file:
        size = file.userblock_size
        found = [(dataset.id.get_offset(), dataset.id.get_storage_size()) for dataset in file["arrays"].values()]
    arrays = sorted([offset, length] for offset, length in found if length)
    content = {"size": path.stat().st_size, "seal_size": size, "arrays": arrays}
    with open(path, "rb") as raw:
        text = json.dumps({**content, "digest": _digest(raw, content)})
    line = f"{FORMAT} {VERSION}\n{text}\n".encode()
    if len(line) > size:
        raise ValueError(f"{path}: seal of {len(line)} bytes for {size}")
    with open(path, "r+b") as raw:
        raw.write(line.ljust(size))


def check_seal(path: Path, raw: BinaryIO | None = None) -> str:
    """Compare a file, except the values of its arrays, with its seal; return the digest. Not collective.

    Parameters
    ----------
    path : Path
    raw : the file opened for reading, in case ``path`` was replaced since; default: opened here

    Raises
    ------
    InputError
        If the file is not a checkpoint, of another version, truncated, or damaged.
    """
    try:
        if raw is None:
            with open(path, "rb") as raw:
                return _checked(path, raw)
        return _checked(path, raw)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; {remedy(path)}") from error


def _checked(path: Path, raw: BinaryIO) -> str:
    raw.seek(0)
    head = raw.read(LARGEST_SEAL).split(b"\n", 2)
    first = head[0].decode(errors="replace")
    name, _, version = first.rpartition(" ")
    if name != FORMAT:
        raise InputError(f"{path}: not a checkpoint of pfem_petsc, or damaged at its beginning; {remedy(path)}")
    if version != str(VERSION):
        raise InputError(
            f"{path}: has version {version} of the checkpoint format, this program reads {VERSION}: restart with "
            f"the version of pfem_petsc that wrote it, or {remedy(path)}"
        )
    digest = None
    try:
        content: dict[str, Any] = json.loads(head[1])
        size, digest = int(content["size"]), content.pop("digest")
        actual = os.fstat(raw.fileno()).st_size
        if actual != size:
            raise InputError(f"{path}: damaged: has {actual} bytes of {size}; {remedy(path)}")
        sound = _digest(raw, content) == digest
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, AttributeError):
        sound = False
    if not sound:
        raise InputError(f"{path}: damaged: the description of its content does not match the digest; {remedy(path)}")
    return str(digest)


def remedy(path: Path) -> str:
    """Return what a user can do without this checkpoint."""
    previous = path.with_name(f"{path.stem}-previous{path.suffix}")
    if previous.is_file():
        return f"restart from the one before: --restart {previous}"
    return "start without --restart"


def _digest(raw: BinaryIO, content: dict[str, Any]) -> str:
    """Return a digest of the seal's content and of all bytes after the user block except values of arrays."""
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    position = int(content["seal_size"])
    for offset, length in [*content["arrays"], [int(content["size"]), 0]]:
        raw.seek(position)
        while position < offset:
            block = raw.read(min(BLOCK, offset - position))
            if not block:
                raise ValueError("the file ends early")
            digest.update(block)
            position += len(block)
        position = offset + length
    return digest.hexdigest()
