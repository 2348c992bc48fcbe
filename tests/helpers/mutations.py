"""Case and mesh files with random mistakes, and the response of ``check`` to them."""

from __future__ import annotations

import contextlib
import io
import random
import re
import signal
from pathlib import Path

import pfem_petsc
from pfem_petsc import Truss
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli.main import main

from .samples import BARS, GMSH, LEGS, POINTS, TOP, write_hdf5, write_vtk

# A refusal must name, besides the file, a key or line of a case, or a section, line, dataset, node or bar of a mesh.
OF_A_CASE = re.compile(
    r"line \d+|end of document|^(no |the table )?\[|^[\w.\[\]\"'\\-]+( = | \(|: )|^\.\.\. and|^wall '"
)
OF_A_MESH = re.compile(r"section \$|line \d+|/\w+|node \d|bar \d|\$MeshFormat|the name of a section")

LIMIT = 60  # seconds that a check may take, on a machine with other work

ODD = [
    "-1",
    "0",
    "-0.0",
    "1",
    "2",
    "3.5",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-308",
    "5e-324",
    "1e400",
    "99999999999999999999",
    "9223372036854775807",
    "2147483648",
    "true",
    "false",
    "[]",
    "{}",
    "[[]]",
    "[1]",
    "[1,2]",
    "[0,0,0]",
    "[nan,0,0]",
    "''",
    "'x'",
    "'x\\u0000'",
    '"""a\nb"""',
    "1979-05-27",
    "0x10",
    "1_000",
]

CASE_OF_A_MESH = """
title = "mesh"
[mesh]
file = "{name}"
[material.m]
young_modulus = 2.1e11
density = 7850.0
[section.s]
area = 1e-4
material = "m"
[time]
integrator = "newmark"
step = 1e-5
end = 1e-3
"""


def mutated_bytes(raw: bytes, chance: random.Random) -> bytes:
    """Apply one to four changes of bytes: flip, remove, repeat, move, truncate, insert."""
    raw = bytearray(raw)
    for _ in range(chance.choice([1, 1, 2, 4])):
        n = max(len(raw), 1)
        at, length = chance.randrange(n), min(chance.choice([1, 1, 2, 8, 64, 500]), n)
        kind = chance.randrange(7)
        if kind == 0:
            raw[at : at + 1] = bytes([chance.randrange(256)])
        elif kind == 1:
            del raw[at : at + length]
        elif kind == 2:
            raw[at:at] = raw[at : at + length]
        elif kind == 3:
            del raw[at:]
        elif kind == 4:
            raw[at : at + length] = bytes(chance.randrange(256) for _ in range(length))
        elif kind == 5:
            piece = bytes(raw[at : at + length])
            del raw[at : at + length]
            there = chance.randrange(len(raw) + 1)
            raw[there:there] = piece
        elif raw:
            raw[at % len(raw)] ^= 1 << chance.randrange(8)
    return bytes(raw)


def mutated_text(text: str, chance: random.Random) -> str:
    """Apply one to three changes of user input: values, keys, lines."""
    for _ in range(chance.choice([1, 1, 1, 2, 3])):
        lines = text.split("\n")
        at = chance.randrange(len(lines))
        kind = chance.randrange(8)
        if kind <= 2:
            numbers = list(re.finditer(r"-?\d[\d.eE+-]*|\"[^\"\n]*\"|\[[^\]\n]*\]", text))
            if numbers:
                one = chance.choice(numbers)
                text = text[: one.start()] + chance.choice(ODD) + text[one.end() :]
            continue
        if kind == 3:
            del lines[at]
        elif kind == 4:
            lines.insert(chance.randrange(len(lines) + 1), lines[at])
        elif kind == 5:
            other = chance.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == 6 and lines[at]:
            k = chance.randrange(len(lines[at]))
            lines[at] = (
                lines[at][:k] + chance.choice(["", "x", " ", "[", "]", '"', "=", ".", "\\"]) + lines[at][k + 1 :]
            )
        elif kind == 7:
            lines[at] = f"{chance.choice(['zz', 'time.end', 'name', 'step'])} = {chance.choice(ODD)}"
        text = "\n".join(lines)
    return text


def small_cases() -> list[str]:
    """Return the texts of the built-in cases with small meshes."""
    folder = Path(pfem_petsc.__file__).parent / "cases"
    texts = [(folder / f"{name}.toml").read_text() for name in built_in_cases()]
    return [re.sub(r"cells = \[[^\]]*\]", "cells = [2, 2, 2]", text) for text in texts]


def sound_meshes(folder: Path) -> list[Path]:
    """Write small mesh files of every supported format."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name, raw in GMSH.items():
        found.append(folder / f"{name.replace(' ', '-')}.msh")
        found[-1].write_bytes(raw)
    for name, write in (("mesh.h5", write_hdf5), ("mesh.vtu", write_vtk), ("mesh.vtkhdf", write_vtk)):
        write(folder / name)
        found.append(folder / name)
    truss = Truss(POINTS, BARS, node_groups={"top": TOP}, bar_groups={"legs": LEGS}, bar_fields={"area": [1e-4] * 6})
    found += [truss.write(folder / name) for name in ("mesh.inp", "mesh.3mf", "mesh_nodes.csv")]
    found.append(found[-1].with_name("mesh_bars.csv"))
    found.append(folder / "parts.inp")
    tower = Path(pfem_petsc.__file__).parents[1] / "meshes" / "tower.inp"
    found[-1].write_text(tower.read_text().replace("1000.\n          0.", "1001.\n          0."))
    corners = "\n".join(f"vertex {x} {y} {z}" for x, y, z in POINTS[[0, 1, 2, 0, 1, 3]])
    found.append(folder / "mesh.stl")
    found[-1].write_text(f"solid\nfacet normal 0 0 1\nouter loop\n{corners}\nendloop\nendfacet\nendsolid\n")
    return found


class TooSlow(BaseException):
    """The check did not end in time; not an Exception, so that nothing catches it."""


def _ring(*_: object) -> None:
    raise TooSlow


def verdict(path: Path, place: re.Pattern[str]) -> tuple[str, str]:
    """Check a case: ``accepted``, refused by ``file and place`` or ``file alone``, or ``bad`` and what went wrong."""
    out, err = io.StringIO(), io.StringIO()
    signal.signal(signal.SIGALRM, _ring)
    signal.alarm(LIMIT)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(["check", str(path)])
    except TooSlow:
        return "bad", f"hangs: no answer in {LIMIT} s"
    except BaseException as error:  # noqa: BLE001 - nothing may come out of main
        return "bad", f"raises {type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    said = err.getvalue()
    if "Traceback" in said or "internal error" in said:
        return "bad", f"status {status}: {said}"
    if status == 0:
        return ("accepted", "") if "error" not in said else ("bad", f"status 0, but: {said}")
    if status != 2:
        return "bad", f"status {status}: {said}"
    if not said.startswith("error: ") or str(path.parent) not in said:
        return "bad", f"does not name the file: {said}"
    lines = said.strip().removeprefix("error: ").split("\n")
    named = all(place.search(line.partition(": ")[2] if ": " in line else line) for line in lines)
    return ("file and place" if named else "file alone"), said


def try_one(seed: int, folder: Path, texts: list[str], meshes: list[Path]) -> tuple[str, str]:
    """Write the mutant of a seed and check it: verdict and text. Two thirds are cases, which must name their place."""
    chance = random.Random(seed)
    path = folder / "case.toml"
    if seed % 3 < 2:
        text = chance.choice(texts)
        if chance.random() < 0.8:
            path.write_bytes(mutated_text(text, chance).encode("utf-8", "surrogateescape"))
        else:
            path.write_bytes(mutated_bytes(text.encode(), chance))
        kind, said = verdict(path, OF_A_CASE)
        return ("bad", f"names neither key nor line: {said}") if kind == "file alone" else (kind, said)
    sound = chance.choice(meshes)
    for pair in sound.parent.glob("*.csv"):
        (folder / pair.name).write_bytes(pair.read_bytes())
    (folder / sound.name).write_bytes(mutated_bytes(sound.read_bytes(), chance))
    path.write_text(CASE_OF_A_MESH.format(name=sound.name))
    return verdict(path, OF_A_MESH)
