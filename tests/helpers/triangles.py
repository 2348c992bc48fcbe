"""Points (n, 3) and corners (t, 3) of surfaces of triangles."""

from __future__ import annotations

import numpy as np


def box(low, high):
    """Points and corners of a box, normals outwards."""
    points = np.array([[(low, high)[b >> k & 1][k] for k in range(3)] for b in range(8)], dtype=float)
    quads = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
    return points, np.array([part for a, b, c, d in quads for part in ((a, b, c), (a, c, d))])


def ball(level):
    """A sphere of radius 1: an octahedron, whose triangles are divided into four ``level`` times."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    corners = np.array([[x, 2 + y, 4 + z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    odd = corners.sum(axis=1) % 2 == 1
    corners[odd] = corners[odd, ::-1]
    for _ in range(level):
        ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2)
        edges, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        middle = len(points) + number.reshape(-1, 3)
        points = np.concatenate([points, points[edges].mean(axis=1)])
        (a, b, c), (ab, bc, ca) = corners.T, middle.T
        corners = np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), middle.T)])
        points /= np.linalg.norm(points, axis=1)[:, None]
    return points, corners


def torus(around=18, across=9, radius=0.4):
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = 2 * np.pi * u / around, 2 * np.pi * v / across
    out = 1.0 + radius * np.cos(b)
    points = np.stack([out * np.cos(a), out * np.sin(a), radius * np.sin(b)], axis=2).reshape(-1, 3)
    one, two = (np.stack([u, u + 1, u + 1, u], axis=2) % around, np.stack([v, v, v + 1, v + 1], axis=2) % across)
    quads = (one * across + two).reshape(-1, 4)
    return points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def groove():
    """An open sheet: two rectangles that fall towards the line x = 0, z = 0 with the slope 1/2."""
    points = np.array([[x, y, abs(x) / 2] for x in (-2.0, 0.0, 2.0) for y in (-3.0, 3.0)])
    return points, np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])


def write_surface(file, points, corners, comm):
    """Write a surface to an OBJ file, on rank 0; return its name. Collective."""
    if comm.rank == 0:
        rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
        rows += ["f " + " ".join(str(k + 1) for k in corner) for corner in corners.tolist()]
        file.write_text("\n".join(rows) + "\n")
    comm.Barrier()
    return str(file)
