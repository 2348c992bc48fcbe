"""One small truss in every supported file format, written by other programs if possible."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

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
