"""Bars with prescribed rest lengths between two supports, and a node held by a fan of them."""

from helpers.mesh_files import case_of
from pfem_petsc import Case, open_result

YOUNG, AREA, DENSITY, LENGTH = 2e9, 1e-4, 1000.0, 2.0


def rod(section, material=(), ends=("start", "end"), time=(), **tables):
    """A rod of two bars along x: ends held along x, all nodes across."""
    data = {
        "mesh": {"generator": "rod", "length": LENGTH, "elements": 2},
        "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY, **dict(material)}},
        "section": {"s": {"area": AREA, "material": "m", **section}},
        "support": [{"node_set": "all", "fix": "yz"}, *({"node_set": end, "fix": "x"} for end in ends)],
        "output": {"probe": [{"name": "all", "node_set": "all"}]},
    } | tables
    if "static" not in data and "stage" not in data:
        data["time"] = {"integrator": "newmark", "step": 1e-4, "end": 2e-4, **dict(time)}
    return Case.from_dict(data)


def cell(folder, comm, name, snapshot=0):
    """A cell field, the same on all ranks."""
    return comm.bcast(open_result(folder).field(name, snapshot) if comm.rank == 0 else None)


def fan(folder, comm, value, key="pretension", **tables):
    """A node held by three cables, one of them stressed; loaded down."""
    points = [[0.0, 0.0, 0.0], [-1.0, 0.0, 1.0], [1.0, 0.5, 1.0], [0.3, -1.0, 1.0], [0.2, 0.3, -1.0]]
    bars = [[0, 1], [0, 2], [0, 3], [0, 4]]
    tables = {
        "node_set": {"anchors": {"indices": [1, 2, 3, 4]}, "knot": {"indices": [0]}},
        "material": {"steel": {"young_modulus": YOUNG, "density": DENSITY}},
        "section": {"default": {"area": AREA, "material": "steel", key: value}},
        "support": [{"node_set": "anchors", "fix": "xyz"}],
        "output": {"probe": [{"name": "knot", "node_set": "knot"}]},
    } | tables
    return case_of(folder, comm, points, bars, **tables)
