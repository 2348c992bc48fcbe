"""Two rods that meet through a contact pair, and half of the symmetric model."""

TRAPEZOID = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5}
DIRECTION = [2.0, 0.0, 0.0]


def two_rods(integrator="central_differences", linear="auto", **pair):
    """Equal rods that fly at each other; wave speed 1, gap 0.1."""
    return {
        "mesh": {"generator": "two_rods", "length": 1.0, "elements": 10, "gap": 0.1},
        "node_set": {
            "left": {"group": "first_end"},
            "right": {"group": "second_start"},
            "second": {"box": [[1.05, -1, -1], [3, 1, 1]]},
        },
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "initial": {"velocity": [0.1, 0, 0], "on": [{"node_set": "second", "velocity": [-0.1, 0, 0]}]},
        "contact_pair": [{"name": "faces", "first": "left", "second": "right", "direction": DIRECTION, **pair}],
        "time": {"integrator": integrator, "step": 0.02, "end": 4.0},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13, "linear": linear},
    }


def half():
    case = two_rods()
    case["mesh"] = {"generator": "rod", "length": 1.0, "elements": 10}
    case["node_set"] = {"left": {"group": "end"}}
    case["initial"] = {"velocity": [0.1, 0, 0]}
    del case["contact_pair"]
    case["wall"] = [
        {"type": "plane", "name": "symmetry", "point": [1.05, 0, 0], "normal": [-1.0, 0, 0], "node_set": "left"}
    ]
    return case
