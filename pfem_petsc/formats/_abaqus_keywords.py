"""Keywords, parameters and data lines of Abaqus and CalculiX input files, with the files that they include."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..files import readable_whole
from ._common import number_of, numbers_of, shown

KNOWN: dict[str, tuple[str, ...]] = {
    "AMPLITUDE": ("NAME", "DEFINITION", "TIME", "VALUE"),
    "ASSEMBLY": ("NAME",),
    "BEAM GENERAL SECTION": (*("ELSET", "SECTION", "MATERIAL", "DENSITY", "POISSON", "ZERO"), "LUMPED"),
    "BEAM SECTION": (*("ELSET", "SECTION", "MATERIAL", "POISSON", "TEMPERATURE"), "LUMPED"),
    "BOUNDARY": ("OP", "TYPE", "AMPLITUDE", "FIXED"),
    "CLOAD": ("OP", "AMPLITUDE"),
    "DAMPING": ("ALPHA", "BETA"),
    "DASHPOT": ("ELSET", "NONLINEAR", "ORIENTATION"),
    "DENSITY": (),
    "DLOAD": ("OP", "AMPLITUDE"),
    "ELASTIC": ("TYPE",),
    "ELEMENT": ("TYPE", "ELSET", "INPUT"),
    "ELSET": ("ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED"),
    "EXPANSION": ("TYPE", "ZERO"),
    "FRAME SECTION": ("ELSET", "SECTION", "DENSITY", "ZERO"),
    "INITIAL CONDITIONS": ("TYPE", "INPUT"),
    "INSTANCE": ("NAME", "PART"),
    "MASS": ("ELSET", "TYPE"),
    "MATERIAL": ("NAME",),
    "NO COMPRESSION": (),
    "NO TENSION": (),
    "NODE": ("NSET", "SYSTEM", "INPUT"),
    "NSET": ("NSET", "ELSET", "GENERATE", "INSTANCE", "INTERNAL", "UNSORTED"),
    "PART": ("NAME",),
    "PLASTIC": ("HARDENING", "RATE"),
    "SOLID SECTION": ("ELSET", "MATERIAL", "CONTROLS"),
    "SPRING": ("ELSET", "NONLINEAR", "ORIENTATION"),
    "STEP": (*("NAME", "NLGEOM", "INC", "INCF", "AMPLITUDE", "PERTURBATION", "UNSYMM", "CONVERT SDI"), "EXTRAPOLATION"),
    "TEMPERATURE": ("OP", "AMPLITUDE"),
}
"""Parameters of keywords that are read, or that change nothing for bars; others are told."""
_ENDS = ("END STEP", "END PART", "END INSTANCE", "END ASSEMBLY")
_SPACED = {name.replace(" ", ""): name for name in (*KNOWN, *_ENDS)}
"""Keywords by their letters: CalculiX ignores the blanks in them."""

_DEEPEST = 20
"""Number of files that include one another."""

_SHORT = 200
"""Number of letters up to which lines are read one by one, which is faster then."""

_COMMENT = re.compile(rb"^[ \t]*\*\*[^\n]*", re.MULTILINE)
_KEYWORD = re.compile(rb"(^[ \t]*\*(?:[^\n]*,[ \t]*\n(?![ \t]*\*))*[^\n]*\n?)", re.MULTILINE)
"""A line that begins with an asterisk, with those that continue it after a comma."""
_COMMA = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')
"""A comma outside of quotes."""
_BLANKS = bytes.maketrans(b",Dd", b" ee")  # of Fortran's exponents as well: 1.D+3


class Piece(NamedTuple):
    """Data lines of a file, from the line of a number on."""

    path: Path
    line: int
    text: bytes


@dataclass
class Block:
    """A keyword, in capitals without the asterisk, with its parameters and data lines."""

    path: Path
    line: int
    keyword: str
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

    def lines(self, *pieces: Piece) -> Iterator[tuple[str, list[str]]]:
        """Return where it is, and the words between commas, of each data line; a last empty one is left out."""
        for path, first, text in pieces or self.pieces:
            for number, line in enumerate(text.split(b"\n"), first):
                if line.strip():
                    words = words_of(line.decode("utf-8", "replace"))
                    some = words[:-1] if len(words) > 1 and not words[-1] else words
                    yield f"{path}: line {number}: *{self.keyword}", some

    def rows(self, width: int, least: int = 1) -> np.ndarray:
        """Return the numbers of all data lines, (lines, width): NaN where a line has fewer, and at least ``least``.

        Raises
        ------
        InputError
            Naming file and line, for anything else.
        """
        found = [np.empty((0, width))]
        for piece in self.pieces:
            alike = _alike(piece.text) if len(piece.text) > _SHORT else None
            if alike is not None and least <= alike.shape[1] <= width:
                found.append(np.pad(alike, ((0, 0), (0, width - alike.shape[1])), constant_values=np.nan))
            else:
                found += [_row(where, words, width, least) for where, words in self.lines(piece)]
        return np.concatenate(found)

    def numbers(self) -> np.ndarray | None:
        """Return all numbers of the data lines one after the other; None if there is anything else."""
        try:
            return np.concatenate([np.empty(0), *(numbers_of(piece.text.translate(_BLANKS)) for piece in self.pieces)])
        except ValueError:
            return None


def words_of(line: str) -> list[str]:
    """Return the words between the commas of a line."""
    return [word.strip() for word in (_COMMA.split(line) if '"' in line else line.split(","))]


def _row(where: str, words: list[str], width: int, least: int) -> np.ndarray:
    if not least <= len(words) <= width:
        raise InputError(
            f"{where}: {', '.join(words)[:60]!r} has {len(words)} values; expected "
            f"{least}{'' if least == width else f' to {width}'} with commas"
        )
    row = np.full((1, width), np.nan)
    for k, word in enumerate(words):
        row[0, k] = number_of(word)
        if word and np.isnan(row[0, k]):
            raise InputError(f"{where}: {word[:40]!r} is not a number")
    return row


def _alike(text: bytes) -> np.ndarray | None:
    """Return the numbers of lines that have as many each, in a row each; None if they are not so simple."""
    text = text.rstrip(b"\n") + b"\n"
    for tail in (b", \n", b",\n", b"\n\n"):  # commas at the ends, and comments that were left out
        text = text.replace(tail, b"\n")
    try:
        values = numbers_of(text.translate(_BLANKS))
    except ValueError:
        return None
    letters = np.frombuffer(text, np.uint8)
    ends, commas = np.flatnonzero(letters == ord("\n")), np.flatnonzero(letters == ord(","))
    commas = np.diff(np.searchsorted(commas, ends), prepend=0)
    columns = int(commas[0]) + 1
    simple = (commas == commas[0]).all() and len(values) == len(commas) * columns
    return values.reshape(-1, columns) if simple else None


def blocks(path: Path, above: tuple[Path, ...] = (), before: Block | None = None) -> Iterator[Block]:
    """Yield the blocks of a file, and of those that it includes; a block is complete when the next one comes.

    ``above`` are the files that include this one, and ``before`` is the block at that place, whose data may go on here.

    Raises
    ------
    InputError
        For data before the first keyword, and files that cannot be included.
    """
    try:
        content = readable_whole(path).read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise InputError(f"{path}: cannot open: {error.strerror}") from None
    if b"\0" in content:
        raise InputError(f"{path}: is not text: save it as an Abaqus input file in UTF-8 or ASCII")
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    line, block = 1, before
    for k, text in enumerate(_KEYWORD.split(_COMMENT.sub(b"", content))):
        if k % 2:
            found = _keyword(path, line, text.decode("utf-8", "replace"))
            if found.keyword != "INCLUDE":
                block = found
                yield block
            if found.keyword == "INCLUDE" or "INPUT" in found.parameters:
                for inner in blocks(_included(found, path, above), (*above, path), block):
                    block = inner
                    yield inner
        elif text.strip():
            if block is None:
                first = shown(text.strip().split(b"\n")[0])
                raise InputError(f"{path}: line {line}: {first!r} precedes the first *KEYWORD")
            block.pieces.append(Piece(path, line, text))
        line += text.count(b"\n")


def _keyword(path: Path, line: int, text: str) -> Block:
    words = words_of(text.lstrip("* \t"))
    if not words[0]:
        raise InputError(f"{path}: line {line}: {text.strip()[:60]!r} is no keyword")
    keyword, *pairs = [(" ".join(name.upper().split()), value) for name, _, value in (w.partition("=") for w in words)]
    name = _SPACED.get(keyword[0].replace(" ", ""), keyword[0])
    return Block(path, line, name, {name: value.strip().strip('"') for name, value in pairs if name})


def _included(block: Block, path: Path, above: tuple[Path, ...]) -> Path:
    name = block.required("INPUT")
    file = (above[0] if above else path).parent / name
    if len(above) >= _DEEPEST or file.resolve() in {other.resolve() for other in (*above, path)}:
        raise InputError(f"{block.where}: {name} includes itself")
    if not file.is_file():
        raise InputError(f"{block.where}: there is no file {file}")
    return file
