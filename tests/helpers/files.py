"""Mesh files in every format, and case and mesh files with random mistakes."""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import signal
import struct
from pathlib import Path

import numpy as np

import pfem_petsc
from pfem_petsc import Truss
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli.main import main

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0.5, 1.25]])
BARS = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [3, 1], [2, 3]])
LEGS = [3, 4, 5]
TOP = [3]
# Sparse tags, not in order, as Gmsh leaves them after deletions.
TAGS = np.array([10, 7, 300, 21])

NAMES = '$PhysicalNames\n2\n0 5 "top"\n1 9 "legs"\n$EndPhysicalNames\n'
BASE_BARS, LEG_BARS = range(3), range(3, 6)


def gmsh_2_ascii() -> bytes:
    lines = [f"{t} {x} {y} {z}" for t, (x, y, z) in zip(TAGS, POINTS)]
    elements = [f"1 15 2 5 1 {TAGS[3]}"]
    for i, (a, b) in enumerate(TAGS[BARS], 2):
        elements.append(f"{i} 1 2 {9 if i - 2 in LEGS else 0} 1 {a} {b}")
    elements.append(f"99 2 2 0 1 {TAGS[0]} {TAGS[1]} {TAGS[2]}")
    text = f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{NAMES}$Nodes\n4\n" + "\n".join(lines)
    text += f"\n$EndNodes\n$Elements\n{len(elements)}\n" + "\n".join(elements) + "\n$EndElements\n"
    return text.encode()


def gmsh_2_binary(order: str = "<") -> bytes:
    def ints(*values: int) -> bytes:
        return struct.pack(f"{order}{len(values)}i", *values)

    nodes = b"".join(ints(t) + struct.pack(f"{order}3d", *p) for t, p in zip(TAGS, POINTS))
    elements = ints(15, 1, 2) + ints(1, 5, 1, TAGS[3])
    elements += ints(1, 6, 2)
    for i, (a, b) in enumerate(TAGS[BARS], 2):
        elements += ints(i, 9 if i - 2 in LEGS else 0, 1, a, b)
    elements += ints(2, 1, 2) + ints(99, 0, 1, *TAGS[:3])
    head = b"$MeshFormat\n2.2 1 8\n" + ints(1) + b"\n$EndMeshFormat\n" + NAMES.encode()
    return head + b"$Nodes\n4\n" + nodes + b"\n$EndNodes\n$Elements\n8\n" + elements + b"\n$EndElements\n"


def gmsh_4_ascii() -> bytes:
    tags = "\n".join(str(t) for t in TAGS)
    points = "\n".join(f"{x} {y} {z}" for x, y, z in POINTS)

    def bars(numbers: range) -> str:
        return "".join(f"{i + 2} {TAGS[BARS[i, 0]]} {TAGS[BARS[i, 1]]}\n" for i in numbers)

    text = f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{NAMES}"
    text += "$Entities\n1 2 1 0\n4 0.5 0.5 1.25 1 5\n"
    text += "1 0 0 0 1 1 0 0 2 4 -4\n2 0 0 0 1 1 1.25 1 9 0\n1 0 0 0 1 1 0 0 0\n$EndEntities\n"
    text += f"$Nodes\n1 4 7 300\n1 1 0 4\n{tags}\n{points}\n$EndNodes\n"
    text += f"$Elements\n4 8 1 99\n0 4 15 1\n1 {TAGS[3]}\n1 1 1 3\n{bars(BASE_BARS)}1 2 1 3\n{bars(LEG_BARS)}"
    text += f"2 1 2 1\n99 {TAGS[0]} {TAGS[1]} {TAGS[2]}\n$EndElements\n"
    return text.encode()


def gmsh_4_binary(order: str = "<") -> bytes:
    def ints(*values: int) -> bytes:
        return struct.pack(f"{order}{len(values)}i", *values)

    def sizes(*values: int) -> bytes:
        return struct.pack(f"{order}{len(values)}Q", *(int(v) for v in values))

    def reals(*values: float) -> bytes:
        return struct.pack(f"{order}{len(values)}d", *values)

    def bars(numbers: range) -> bytes:
        return b"".join(sizes(i + 2, *TAGS[BARS[i]]) for i in numbers)

    entities = sizes(1, 2, 1, 0) + ints(4) + reals(0.5, 0.5, 1.25) + sizes(1) + ints(5)
    entities += ints(1) + reals(0, 0, 0, 1, 1, 0) + sizes(0) + sizes(2) + ints(4, -4)
    entities += ints(2) + reals(0, 0, 0, 1, 1, 1.25) + sizes(1) + ints(9) + sizes(0)
    entities += ints(1) + reals(0, 0, 0, 1, 1, 0) + sizes(0) + sizes(0)
    nodes = sizes(1, 4, 7, 300) + ints(1, 1, 0) + sizes(4) + sizes(*TAGS) + reals(*POINTS.ravel())
    elements = sizes(4, 8, 1, 99) + ints(0, 4, 15) + sizes(1) + sizes(1, TAGS[3])
    elements += ints(1, 1, 1) + sizes(3) + bars(BASE_BARS) + ints(1, 2, 1) + sizes(3) + bars(LEG_BARS)
    elements += ints(2, 1, 2) + sizes(1) + sizes(99, *TAGS[:3])
    parts = [b"$MeshFormat\n4.1 1 8\n" + ints(1) + b"\n$EndMeshFormat\n" + NAMES.encode()]
    for name, payload in ((b"Entities", entities), (b"Nodes", nodes), (b"Elements", elements)):
        parts.append(b"$" + name + b"\n" + payload + b"\n$End" + name + b"\n")
    return b"".join(parts)


GMSH = {
    "2.2 ascii": gmsh_2_ascii(),
    "2.2 binary": gmsh_2_binary(),
    "2.2 binary, big-endian": gmsh_2_binary(">"),
    "4.1 ascii": gmsh_4_ascii(),
    "4.1 binary": gmsh_4_binary(),
    "4.1 binary, big-endian": gmsh_4_binary(">"),
}


def write_vtk(path: Path) -> None:
    """As pyvista writes it: .vtu compressed and appended, or .vtkhdf."""
    import pyvista

    cells = np.insert(BARS, 0, 2, axis=1).ravel()
    grid = pyvista.UnstructuredGrid(cells, np.full(len(BARS), 3, np.uint8), POINTS)
    grid.cell_data["section"] = np.isin(np.arange(len(BARS)), LEGS).astype(np.int32)
    grid.point_data["group"] = np.where(np.isin(np.arange(len(POINTS)), TOP), 2, -1)
    # VTK writes no strings to .vtkhdf.
    if path.suffix == ".vtu":
        grid.field_data["section_names"] = ["base", "legs"]
    grid.save(path)


def write_hdf5(path: Path) -> None:
    """Chunked and compressed, single precision, 32-bit: another writer's choices."""
    import h5py

    with h5py.File(path, "w", locking=False) as file:
        file.create_dataset("points", data=POINTS.astype(np.float32), chunks=True, compression="gzip")
        file.create_dataset("bars", data=BARS.astype(np.int32))
        file["node_groups/top"] = np.array(TOP)
        file["bar_groups/legs"] = np.array(LEGS[::-1], dtype=np.uint8)


MESHES = Path(__file__).parents[2] / "meshes"

FLAT = """*HEADING
 A tripod, written by hand
**
*Node, nset=ALL
1, 0., 0.
10, 1.D+0, 0., 0.
  7,5.0d-1 , 1.0, 0.0,
** a comment between data lines

21, .5, , 1.25E0
*ELEMENT, TYPE=t3d2,
   ELSET=Base
1, 1, 10
2, 10, 7

5, 7, 1
*Element, type=T3D2, elset=LEGS
11, 1, 21
12, 21, 10
20, 7, 21
*NSET, NSET=Top
21,
*NSET, NSET=Feet, GENERATE
1, 10
*NSET, NSET = every one
top, FEET
*NSET, NSET=Top
7
*ELSET, ELSET=some, GENERATE
1, 11, 5
*MATERIAL, NAME=Steel
*ELASTIC, TYPE=ISOTROPIC
210.E9, .3, 20.
205.E9, .3, 100.
*DENSITY
7850.,
*EXPANSION
1.2e-5
*Damping, alpha=2., beta=1.E-5
*SOLID SECTION, ELSET=base, MATERIAL=STEEL
1.D-4,
*SOLID SECTION, ELSET=legs, MATERIAL=steel
2.E-4
*STEP
*CLOAD
21, 3, -1.
*END STEP
"""


def written(folder, text, name="a.inp"):
    (folder / name).write_text(text)
    return folder / name


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
    vertices = "\n".join(f"v {x} {y} {z}" for x, y, z in POINTS)
    places, ends = vertices.replace("v ", ""), "\n".join(f"{a} {b}" for a, b in BARS)
    header = f"element vertex {len(POINTS)}\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    header += f"element edge {len(BARS)}\nproperty int vertex1\nproperty int vertex2\nend_header"
    network = {"node": {str(i): dict(zip("xyz", row)) for i, row in enumerate(np.asarray(POINTS).tolist())}, "edge": {}}
    for a, b in np.asarray(BARS).tolist():
        network["edge"].setdefault(str(a), {})[str(b)] = {"q": 1.0}
    for name, text in (
        ("mesh.obj", f"{vertices}\no legs\n" + "".join(f"l {a + 1} {b + 1}\n" for a, b in BARS)),
        ("mesh.ply", f"ply\nformat ascii 1.0\n{header}\n{places}\n{ends}\n"),
        ("mesh.json", json.dumps(network)),
    ):
        found.append(folder / name)
        found[-1].write_text(text)
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
    lines = [
        line for line in lines if not re.match(r"\s*(\d+ \||\^)", line)
    ]  # those of the file, shown after its place
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
