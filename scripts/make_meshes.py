"""Creates example meshes of ``meshes/``, byte for byte identical at every call.

    .venv/bin/python scripts/make_meshes.py

- ``space_truss.msh`` (Gmsh 2.2): an irregular ball of bars along the edges of a Delaunay tetrahedralisation.
- ``bridge.msh`` (Gmsh 2.2): the plane bridge of ``docs/case_file.md``, 8 m in eight bays, 1 m high.
- ``bracket.stl`` (in ``pfem_petsc/cases``): the closed surface of an angle bracket with three holes, in millimetres.

``ring.msh`` (Gmsh 4.1) is the ring of the generator: circular plane truss, X-braced, 14 bays, radii 22.83 and 22.37 m,
one node towards +x. ``mast.vtu`` is a square section of a guyed mast, as text with the names of its groups.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent.parent / "meshes"


def write_gmsh(path: Path, points: np.ndarray, names: list[str], elements: list[str]) -> None:
    """Write a file of Gmsh 2.2: ``names`` are lines of physical names, ``elements`` type, tags and nodes from 1."""
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(names)), *names]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(points))]
    lines += [f"{k} {' '.join(repr(float(value)) for value in point)}" for k, point in enumerate(points, 1)]
    lines += ["$EndNodes", "$Elements", str(len(elements)), *(f"{k} {each}" for k, each in enumerate(elements, 1))]
    path.write_text("\n".join([*lines, "$EndElements", ""]))


def make_space_truss(path: Path) -> None:
    """Write a ball of radius 1 m: bars on the edges of tetrahedra between jittered points, with its skin as a group."""
    import pyvista

    random = np.random.default_rng(20180842)
    spacing, radius = 0.3, 1.0
    grid = np.stack(np.meshgrid(*[np.arange(-4, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    # Face-centred positions, the densest packing, before they are moved.
    inside = grid[grid.sum(axis=1) % 2 == 0] * (spacing / np.sqrt(2.0))
    inside = inside[np.linalg.norm(inside, axis=1) < radius - 0.5 * spacing]
    inside = inside + random.uniform(-0.15, 0.15, inside.shape) * spacing
    # Points on the sphere along a golden spiral.
    n_skin = 120
    k = np.arange(n_skin) + 0.5
    z, angle = 1.0 - 2.0 * k / n_skin, np.pi * (1.0 + np.sqrt(5.0)) * k
    skin = radius * np.stack([np.sqrt(1.0 - z * z) * np.cos(angle), np.sqrt(1.0 - z * z) * np.sin(angle), z], axis=1)
    points = np.round(np.concatenate([skin, inside]), 6)
    tetrahedra = pyvista.PolyData(points).delaunay_3d().cells_dict[pyvista.CellType.TETRA]
    corners = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    bars = np.unique(np.sort(np.concatenate([tetrahedra[:, pair] for pair in corners]), axis=1), axis=0)
    faces = np.sort(np.concatenate([np.delete(tetrahedra, i, axis=1) for i in range(4)]), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    hull = faces[count == 1]
    hull = np.unique(np.concatenate([hull[:, pair] for pair in ((0, 1), (0, 2), (1, 2))]), axis=0)
    on_skin = np.isin(bars[:, 0] * len(points) + bars[:, 1], hull[:, 0] * len(points) + hull[:, 1])
    lowest, highest = int(points[:, 2].argmin()), int(points[:, 2].argmax())
    names = ['0 1 "lowest"', '0 2 "highest"', '1 1 "skin"', '1 2 "core"']
    elements = [f"15 2 1 1 {lowest + 1}", f"15 2 2 2 {highest + 1}"]
    for (start, end), group in zip((bars + 1).tolist(), np.where(on_skin, 1, 2)):
        elements.append(f"1 2 {group} {group} {start} {end}")
    write_gmsh(path, points, names, elements)


def make_bridge(path: Path) -> None:
    """Write a plane truss of eight bays in x and z, with its supports and chords as physical groups."""
    bays = 8
    points = [(float(k), 0.0, 0.0) for k in range(bays + 1)] + [(k + 0.5, 0.0, 1.0) for k in range(bays)]
    top = bays + 1
    chords = [(k, k + 1) for k in range(bays)] + [(top + k, top + k + 1) for k in range(bays - 1)]
    diagonals = [pair for k in range(bays) for pair in ((k, top + k), (top + k, k + 1))]
    elements = [f"15 2 1 1 {1}", f"15 2 2 2 {bays + 1}"]
    elements += [f"1 2 3 3 {a + 1} {b + 1}" for a, b in chords] + [f"1 2 4 4 {a + 1} {b + 1}" for a, b in diagonals]
    write_gmsh(path, np.array(points), ['0 1 "left"', '0 2 "right"', '1 3 "chords"', '1 4 "diagonals"'], elements)


def make_bracket(path: Path) -> None:
    """Write an angle of 80 x 48 x 80 mm, 16 mm thick, with two holes of 14 mm in its base and one of 24 mm above."""
    width, thick, height, depth = 80.0, 16.0, 80.0, 48.0
    turns = 2.0 * np.pi * np.arange(48) / 48
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    base_holes = [(36.0, 24.0) + 7.0 * circle, (62.0, 24.0) + 7.0 * circle]
    back_hole = (24.0, 54.0) + 12.0 * circle

    def rectangle(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
        return np.array([low, (high[0], low[1]), high, (low[0], high[1])])

    side = np.array([(0, 0), (width, 0), (width, thick), (thick, thick), (thick, height), (0, height)], dtype=float)
    triangles = []
    for axis, level, outwards, outline, holes in (
        (2, 0.0, -1, rectangle((0, 0), (width, depth)), base_holes),
        (2, thick, 1, rectangle((thick, 0), (width, depth)), base_holes),
        (0, 0.0, -1, rectangle((0, 0), (depth, height)), [back_hole]),
        (0, thick, 1, rectangle((0, thick), (depth, height)), [back_hole]),
        (0, width, 1, rectangle((0, 0), (depth, thick)), []),
        (2, height, 1, rectangle((0, 0), (thick, depth)), []),
        (1, 0.0, -1, side, []),
        (1, depth, 1, side, []),
    ):
        for corners in _face(outline, holes):
            # normals of corners in the order (x, y), (y, z) are +z and +x, those of (x, z) are -y
            turned = (outwards > 0) == (axis != 1)
            triangles.append(np.insert(corners, axis, level, axis=1)[:: 1 if turned else -1])
    for axis, hole in ((2, base_holes[0]), (2, base_holes[1]), (0, back_hole)):
        low, high = (np.insert(hole, axis, level, axis=1) for level in (0.0, thick))
        for a, b, c, d in zip(low, np.roll(low, -1, axis=0), high, np.roll(high, -1, axis=0)):
            triangles += [np.array([a, c, b]), np.array([b, c, d])]
    rows = np.zeros(len(triangles), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    rows["corners"] = triangles
    path.write_bytes(b"angle bracket, mm".ljust(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())


def _face(outline: np.ndarray, holes: list[np.ndarray]) -> list[np.ndarray]:
    """Return triangles (3, 2), counterclockwise, of a polygon (corners, 2), counterclockwise, with holes."""
    import pyvista

    loops = [outline, *(hole[::-1] for hole in holes)]
    points = np.vstack(loops)
    starts = np.cumsum([0, *map(len, loops)])
    faces = np.concatenate(
        [[len(loop), *range(start, start + len(loop))] for loop, start in zip(loops, starts.tolist())]
    )
    source = pyvista.PolyData(np.insert(points, 2, 0.0, axis=1), faces=faces)
    found = pyvista.PolyData(source.points).delaunay_2d(edge_source=source).regular_faces
    corners = points[found]
    edges = corners[:, 1:] - corners[:, :1]
    sense = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    return [each if positive else each[::-1] for each, positive in zip(corners, sense > 0.0)]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    FOLDER.mkdir(exist_ok=True)
    make_space_truss(FOLDER / "space_truss.msh")
    make_bridge(FOLDER / "bridge.msh")
    make_bracket(FOLDER.parent / "pfem_petsc" / "cases" / "bracket.stl")
