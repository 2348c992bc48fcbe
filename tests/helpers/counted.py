"""Trusses whose mechanisms and states of self-stress are counted by hand."""

CUBE = [[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)]
CUBE_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
TRUSSES = {
    # points, bars, fixed nodes; free unknowns, rigid motions, mechanisms, states of self-stress, unbraced nodes
    "triangle": ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [(0, 1), (1, 2), (2, 0)], [], (6, 3, 0, 0, 0)),
    "square": ([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [(0, 1), (1, 2), (2, 3), (3, 0)], [], (8, 3, 1, 0, 0)),
    "square, both diagonals": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)],
        [],
        (8, 3, 0, 1, 0),
    ),
    "square with a whip": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [3, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (2, 4)],
        [],
        (10, 3, 1, 0, 1),
    ),
    "hinged square": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)],
        [0, 1],
        (4, 0, 0, 1, 0),
    ),
    "tetrahedron": (
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1)],
        [],
        (12, 6, 0, 0, 0),
    ),
    "cube of edges": (CUBE, CUBE_EDGES, [], (24, 6, 6, 0, 0)),
    "tetrahedron, one bar short": (
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)],
        [],
        (12, 6, 1, 0, 2),
    ),
    "chain": ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [(0, 1), (1, 2)], [], (3, 1, 0, 0, 0)),
}
