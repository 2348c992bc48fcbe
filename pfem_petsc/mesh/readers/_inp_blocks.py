"""Keyword blocks of Abaqus input files: keyword, parameters and data lines, with included files in their places."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...files import readable_whole
from ._text import numbers_of

__all__ = ["Block", "blocks"]

_DEEPEST = 20
"""Number of files that include one another."""

_SHORT = 200
"""Number of letters up to which lines are read one by one, which is faster then."""

_STAR = re.compile(rb"^[ \t]*\*", re.MULTILINE)
_PARAMETERS = re.compile(r'(?:"[^"]*"|[^,"])+')
_BLANKS = bytes.maketrans(b",Dd\r", b" ee ")  # of Fortran's exponents as well: 1.D+3


@dataclass
class Piece:
    """Data lines without a keyword or comment between them."""

    path: Path
    line: int
    """Number of the first line."""
    text: bytes

    def lines(self) -> Iterator[tuple[int, str]]:
        """Return number and text of each line that is not blank."""
        for number, line in enumerate(self.text.split(b"\n"), self.line):
            if line.strip():
                yield number, line.decode("utf-8", "replace").strip()


@dataclass
class Block:
    """A keyword with its parameters and data lines."""

    path: Path
    line: int
    keyword: str
    """In capitals, without the asterisk."""
    parameters: dict[str, str]
    """Names in capitals."""
    pieces: list[Piece] = field(default_factory=list)

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.path}: line {self.line}: *{self.keyword}"

    def get(self, name: str, default: str = "") -> str:
        """Return the value of a parameter."""
        return self.parameters.get(name, default)

    def required(self, name: str) -> str:
        """Return the value of a parameter that must be there."""
        value = self.parameters.get(name)
        if not value:
            raise InputError(f"{self.where}: the parameter {name}= is missing")
        return value

    def rows(self, width: int, least: int = 1) -> np.ndarray:
        """Return the numbers of all data lines, (lines, width): NaN where a line has fewer, and at least ``least``.

        Raises
        ------
        InputError
            Naming file and line, for anything else.
        """
        found = [_rows(piece, width, least, self.keyword) for piece in self.pieces]
        return np.concatenate([np.empty((0, width)), *found])

    def words(self) -> Iterator[tuple[Piece, int, list[str]]]:
        """Return piece, number and the words between commas of each data line; a last empty one is left out."""
        for piece in self.pieces:
            for number, line in piece.lines():
                words = [word.strip() for word in line.split(",")]
                yield piece, number, words[:-1] if len(words) > 1 and not words[-1] else words

    def numbers(self) -> np.ndarray | None:
        """Return all numbers of the data lines one after the other; None if there is anything else."""
        try:
            return np.concatenate([np.empty(0), *(numbers_of(piece.text.translate(_BLANKS)) for piece in self.pieces)])
        except ValueError:
            return None


def _rows(piece: Piece, width: int, least: int, keyword: str) -> np.ndarray:
    alike = _alike(piece.text) if len(piece.text) > _SHORT else None
    if alike is not None and least <= alike.shape[1] <= width:
        padded = np.full((len(alike), width), np.nan)
        padded[:, : alike.shape[1]] = alike
        return padded
    rows = []
    for number, line in piece.lines():
        words = line.rstrip(",").split(",")
        where = f"{piece.path}: line {number}: *{keyword}"
        if not least <= len(words) <= width:
            raise InputError(f"{where}: {line[:60]!r} has {len(words)} values; expected {least} to {width} with commas")
        row = [_number(word, where) for word in words]
        rows.append(row + [np.nan] * (width - len(row)))
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _number(word: str, where: str) -> float:
    try:
        return float(word.strip().upper().replace("D", "E")) if word.strip() else np.nan
    except ValueError:
        raise InputError(f"{where}: {word.strip()[:40]!r} is not a number") from None


def _alike(text: bytes) -> np.ndarray | None:
    """Return the numbers of lines that have as many each, in a row each; None if they are not so simple."""
    text = text.strip(b" \t\r\n")
    if not text:
        return None
    try:
        values = numbers_of(text.translate(_BLANKS))
    except ValueError:
        return None
    letters = np.frombuffer(text + b"\n", np.uint8)
    ends = np.flatnonzero(letters == ord("\n"))
    commas = np.flatnonzero(letters == ord(","))
    each = np.diff(np.searchsorted(commas, ends), prepend=0)
    lines = len(ends)
    if each.min() != each.max() or each[0] == 0 and len(values) != lines:
        return None
    columns = int(each[0]) + 1
    if len(values) == lines * columns:
        return values.reshape(lines, columns)  # no value is missing
    before = ends - 1  # with a comma at the end of each line
    for _ in range(3):
        before -= np.isin(letters[before], (ord(" "), ord("\r")))
    if len(values) == lines * (columns - 1) and (letters[before] == ord(",")).all():
        return values.reshape(lines, columns - 1)
    return None


def blocks(path: Path) -> Iterator[Block]:
    """Return the blocks of a file, and of those that it includes.

    Raises
    ------
    InputError
        For data before the first keyword, and files that cannot be included.
    """
    current: Block | None = None
    for part in _parts(path, ()):
        if isinstance(part, Block):
            if current is not None:
                yield current
            current = part
        elif current is None:
            raise InputError(f"{part.path}: line {part.line}: {_shown(part.text)!r} precedes the first *KEYWORD")
        else:
            current.pieces.append(part)
    if current is not None:
        yield current


def _parts(path: Path, above: tuple[Path, ...]) -> Iterator[Block | Piece]:
    """Return keywords and data lines in their order."""
    try:
        content = readable_whole(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise InputError(f"{path}: cannot open: {error.strerror}") from None
    if b"\0" in content:
        raise InputError(f"{path}: is not text: save it as an Abaqus input file in UTF-8 or ASCII")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    starts = [found.start() for found in _STAR.finditer(content)]
    line = 1
    if content[: starts[0] if starts else None].strip():
        yield Piece(path, 1, content[: starts[0] if starts else None])
    line += content.count(b"\n", 0, starts[0]) if starts else 0
    for start, stop in zip(starts, [*starts[1:], len(content)]):
        at, line = line, line + content.count(b"\n", start, stop)
        text, end = _logical_line(content, start)
        data = content[end:stop]
        first = at + content.count(b"\n", start, end)
        if not text.startswith("**"):
            block = _keyword(path, at, text)
            if block.keyword == "INCLUDE":
                yield from _parts(_included(block, path, above), (*above, path))
            else:
                yield block
                if "INPUT" in block.parameters:
                    yield from _parts(_included(block, path, above), (*above, path))
        if data.strip():
            yield Piece(path, first, data)


def _logical_line(content: bytes, start: int) -> tuple[str, int]:
    """Return a keyword line with those that continue it after a comma, and where it ends."""
    text = ""
    while True:
        end = content.find(b"\n", start)
        end = len(content) if end < 0 else end
        text += content[start:end].decode("utf-8", "replace").strip()
        start = min(end + 1, len(content))
        more = text.endswith(",") and not text.startswith("**") and start < len(content)
        if not more or content[start : start + 80].lstrip(b" \t").startswith(b"*"):
            return text, start


def _keyword(path: Path, line: int, text: str) -> Block:
    words = [word.strip() for word in _PARAMETERS.findall(text.lstrip("* \t"))]
    parameters = {}
    for word in words[1:]:
        name, _, value = word.partition("=")
        parameters[" ".join(name.upper().split())] = value.strip().strip('"')
    keyword = " ".join(words[0].upper().split()) if words else ""
    if not keyword:
        raise InputError(f"{path}: line {line}: {text[:60]!r} is no keyword")
    return Block(path, line, keyword, parameters)


def _included(block: Block, path: Path, above: tuple[Path, ...]) -> Path:
    name = block.required("INPUT")
    file = (above[0] if above else path).parent / name
    if len(above) >= _DEEPEST or file.resolve() in {other.resolve() for other in (*above, path)}:
        raise InputError(f"{block.where}: {name} includes itself")
    if not file.is_file():
        raise InputError(f"{block.where}: there is no file {file}")
    return file


def _shown(text: bytes) -> str:
    return text.strip().split(b"\n")[0][:60].decode("utf-8", "replace")
