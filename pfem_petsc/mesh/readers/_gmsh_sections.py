"""Sections of Gmsh .msh files as streams of numbers, ASCII and binary alike."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from ...errors import InputError
from ._text import numbers_of

__all__ = ["Format", "Numbers", "find_sections", "read_entities", "sections"]


class Format:
    """Content of the $MeshFormat section.

    Attributes
    ----------
    version : str
        ``"2.2"`` or ``"4.1"``.
    binary : bool
    order : str
        Byte order of binary numbers, ``"<"`` or ``">"``.
    size_type : str
        NumPy type of C's size_t in a binary file: ``"u4"`` or ``"u8"``.
    """

    def __init__(self, path: Path, payload: bytes) -> None:
        first, _, rest = payload.partition(b"\n")
        fields = first.split()
        where = f"{path}: section $MeshFormat"
        if len(fields) != 3 or fields[1] not in (b"0", b"1") or fields[2] not in (b"4", b"8"):
            raise InputError(f"{where}: {_shown(first)!r} is not 'version file-type data-size', such as '4.1 0 8'")
        # versions 2 to 2.2 differ in nothing that is read here
        self.version = {**dict.fromkeys((b"2", b"2.0", b"2.1", b"2.2"), "2.2"), b"4.1": "4.1"}.get(fields[0], "")
        if not self.version:
            raise InputError(
                f"{where}: version {_shown(fields[0])} is not read; save the mesh as version 4.1 or 2.2 "
                "(in Gmsh: Mesh.MshFileVersion)"
            )
        self.binary = fields[1] == b"1"
        self.size_type = "u" + fields[2].decode()
        self.order = "<"
        if self.binary:
            if rest[:4] not in (b"\x01\0\0\0", b"\0\0\0\x01"):
                raise InputError(f"{where}: the binary number 1 that shows the byte order is missing")
            self.order = "<" if rest[:1] == b"\x01" else ">"


class Numbers:
    """Numbers of one section, read sequentially.

    Parameters
    ----------
    where : str
        File and section, for messages.
    payload : bytes
    layout : Format
    count_line : bool
        Whether the section starts with a count in ASCII, even in a binary file (version 2.2).

    Raises
    ------
    InputError
        From every method, if the section ends early or has other content than requested.
    """

    def __init__(self, where: str, payload: bytes, layout: Format, count_line: bool) -> None:
        self._where = where
        self._binary = layout.binary
        self._order = layout.order
        self._size_type = layout.size_type
        self._at = 0
        if not layout.binary:
            self._values = _parse(where, payload)
        elif count_line:
            first, _, self._bytes = payload.partition(b"\n")
            self._count = _parse(where, first)
            if len(self._count) != 1:
                raise InputError(f"{where}: {_shown(first)!r} is not a count")
        else:
            self._bytes = payload

    def count(self) -> int:
        """Return the count at the start of a section of version 2.2."""
        if self._binary:
            return int(self._whole(self._count)[0])
        return int(self.sizes(1)[0])

    def ints(self, n: int) -> np.ndarray:
        """Return the next ``n`` integers (C's int)."""
        return self._take(n, "i4").astype(np.int64) if self._binary else self._whole(self._take(n))

    def sizes(self, n: int) -> np.ndarray:
        """Return the next ``n`` counts or tags (C's size_t), as int64."""
        values = self._take(n, self._size_type) if self._binary else self._whole(self._take(n))
        if n and (values.min() < 0 or values.max() > np.iinfo(np.int64).max):
            raise InputError(f"{self._where}: {values.min()} ... {values.max()} are not counts or tags")
        return values.astype(np.int64)

    def reals(self, n: int) -> np.ndarray:
        """Return the next ``n`` floating-point numbers."""
        return self._take(n, "f8").astype(np.float64) if self._binary else self._take(n)

    def rows(self, n: int, n_ints: int, n_reals: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the next ``n`` rows of ``n_ints`` integers and ``n_reals`` floating-point numbers."""
        if self._binary:
            row = np.dtype([("i", self._order + "i4", (n_ints,)), ("r", self._order + "f8", (n_reals,))])
            rows = self._cut(n, row)
            return rows["i"].astype(np.int64), rows["r"].astype(np.float64)
        rows = self._take(n * (n_ints + n_reals)).reshape(n, n_ints + n_reals)
        return self._whole(rows[:, :n_ints]), rows[:, n_ints:]

    def peek(self, n: int) -> np.ndarray:
        """Return at most the next ``n`` numbers of an ASCII section without consuming them."""
        return self._values[self._at : self._at + n]

    def end(self) -> None:
        """Refuse surplus numbers."""
        left = len(self._bytes[self._at :].strip()) if self._binary else len(self._values) - self._at
        if left:
            what = "bytes" if self._binary else "numbers"
            raise InputError(f"{self._where}: {left} {what} more than its counts declare")

    def _take(self, n: int, kind: str = "f8") -> np.ndarray:
        if self._binary:
            return self._cut(n, np.dtype(self._order + kind))
        left = len(self._values) - self._at
        if not 0 <= n <= left:
            raise InputError(f"{self._where}: its counts declare {n} numbers where {left} are left; is it truncated?")
        self._at += n
        return self._values[self._at - n : self._at]

    def _cut(self, n: int, dtype: np.dtype) -> np.ndarray:
        left = len(self._bytes) - self._at
        if not 0 <= n * dtype.itemsize <= left:
            raise InputError(
                f"{self._where}: its counts declare {n * dtype.itemsize} bytes where {left} are left; is it truncated?"
            )
        values = np.frombuffer(self._bytes, dtype, n, self._at)
        self._at += n * dtype.itemsize
        return values

    def _whole(self, values: np.ndarray) -> np.ndarray:
        wrong = values[~((np.abs(values) < 2.0**53) & (values == np.rint(values)))]
        if wrong.size:
            raise InputError(f"{self._where}: {wrong.flat[0]:g} is not a count or a tag: a whole number")
        return values.astype(np.int64)


def sections(path: Path, content: bytes) -> dict[str, list[bytes]]:
    """Return the payloads of the sections of a file by name."""
    found: dict[str, list[bytes]] = {}
    at = 0
    while True:
        at = content.find(b"$", at)
        if at < 0:
            break
        newline = content.find(b"\n", at)
        name = content[at + 1 : newline if newline >= 0 else len(content)].strip()
        if not name.isalnum() or newline < 0:
            raise InputError(f"{path}: {_shown(name)!r} is not the name of a section")
        end = content.find(b"$End" + name, newline)
        if end < 0:
            raise InputError(f"{path}: section ${name.decode()} has no end; the file is truncated")
        found.setdefault(name.decode(), []).append(content[newline + 1 : end])
        at = end + 4 + len(name)
    return found


def find_sections(path: Path, file: IO[bytes]) -> dict[str, list[tuple[int, int]]]:
    """Return where in a file the payloads of its sections begin and end, by name, without reading it whole."""
    found: dict[str, list[tuple[int, int]]] = {}
    at = 0
    while (at := _find(file, b"$", at)) >= 0:
        file.seek(at + 1)
        line = file.readline(200)
        name = line.strip()
        end = _find(file, b"$End" + name, at + 1 + len(line)) if name.isalnum() and line.endswith(b"\n") else -1
        if end < 0:
            raise InputError(f"{path}: section {_shown(name)!r} has no end")
        found.setdefault(name.decode(), []).append((at + 1 + len(line), end))
        at = end + 4 + len(name)
    return found


def _find(file: IO[bytes], text: bytes, at: int) -> int:
    """Return the first place of a text in a file from ``at`` on, -1 if there is none."""
    file.seek(at)
    rest = b""
    while block := file.read(1 << 20):
        place = (rest + block).find(text)
        if place >= 0:
            return at - len(rest) + place
        at += len(block)
        rest = (rest + block)[-(len(text) - 1) :] if len(text) > 1 else b""
    return -1


def _parse(where: str, text: bytes) -> np.ndarray:
    """Return all numbers of a text as float64, exact for tags up to 2^53."""
    try:
        return numbers_of(text)
    except ValueError:
        for number, line in enumerate(text.split(b"\n"), 1):
            for word in line.split():
                try:
                    float(word)
                except ValueError:
                    raise InputError(f"{where}, line {number}: {_shown(word)!r} is not a number") from None
        raise InputError(f"{where}: contains text other than numbers") from None


def _shown(text: bytes) -> str:
    return text[:60].decode("utf-8", "replace")


def read_entities(numbers: Numbers) -> dict[tuple[int, int], np.ndarray]:
    """Return the tags of physical groups of every point and curve."""
    groups = {}
    counts = numbers.sizes(4)
    for dimension in (0, 1):
        for _ in range(counts[dimension]):
            tag = int(numbers.ints(1)[0])
            numbers.reals(3 if dimension == 0 else 6)
            groups[dimension, tag] = numbers.ints(int(numbers.sizes(1)[0]))
            if dimension == 1:
                numbers.ints(int(numbers.sizes(1)[0]))
    # Surfaces and volumes follow, which have no bars.
    return groups
