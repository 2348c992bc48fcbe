"""A ground record every 20 ms, and exact responses to it of oscillators and of linear trusses."""

import numpy as np

TIMES = 0.02 * np.arange(76)


def ground(t):
    """Displacement, velocity and acceleration of the ground: a product of slow sines, at rest at the start."""
    a, b = 2.0 * np.pi / 3.0, 2.0 * np.pi * 3.0
    s, c, p, q = np.sin(a * t), np.cos(a * t), np.sin(b * t), np.cos(b * t)
    e, e1, e2 = s**2, 2 * a * s * c, 2 * a * a * (c**2 - s**2)
    return 0.02 * e * p, 0.02 * (e1 * p + e * b * q), 0.02 * (e2 * p + 2 * e1 * b * q - e * b * b * p)


def response(times, values, at, w):
    """Relative displacement of an oscillator under accelerations of its base, linear between rows: exact pieces."""
    found = np.zeros(len(at))
    y, v = 0.0, 0.0
    for t0, t1, a0, a1 in zip(times[:-1], times[1:], -values[:-1], -values[1:]):
        k = (a1 - a0) / (t1 - t0)
        # a particular solution (a0 + k s)/w^2, and what is left as free vibration
        p, q = y - a0 / w**2, (v - k / w**2) / w
        inside = (at >= t0 - 1e-9) & (at <= t1 + 1e-9)
        s = np.append(at[inside] - t0, t1 - t0)
        moved = (a0 + k * s) / w**2 + p * np.cos(w * s) + q * np.sin(w * s)
        found[inside], y = moved[:-1], moved[-1]
        v = k / w**2 + w * (q * np.cos(w * s[-1]) - p * np.sin(w * s[-1]))
    return found


def modal_response(model, stiffness, times, values, at):
    """Displacements (times, nodes, 3) of a truss with equal bars of EA = ``stiffness`` [N] relative to its supports,
    under accelerations of the ground along x; and its lowest circular frequency. Small displacements."""
    points, bars, mass = model.mesh.points, model.mesh.bars, model.inertia.mass
    matrix = np.zeros((3 * len(points), 3 * len(points)))
    for a, b in bars:
        way = points[b] - points[a]
        block = stiffness / np.linalg.norm(way) ** 3 * np.outer(way, way)
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            matrix[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += sign * block
    free = np.flatnonzero(~model.supports.fixed.ravel())
    root = np.sqrt(np.repeat(mass, 3))[free]
    squares, shapes = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(root, root))
    push = root * (free % 3 == 0)
    shaken = [response(times, values, at, np.sqrt(square)) for square in squares]
    moved = np.zeros((len(at), 3 * len(points)))
    moved[:, free] = ((shapes.T @ push)[:, None] * np.array(shaken)).T @ shapes.T / root
    return moved.reshape(len(at), -1, 3), np.sqrt(squares[0])
