"""Cables and bars with prescribed rest lengths: closed forms of chains that hang, and cases."""

from __future__ import annotations

import numpy as np

from helpers.small_models import case_of
from pfem_petsc import Case, Simulation, open_result


def funicular(span, height, rest, stiffness, weights, expansion=0.0):
    """Tension [N] of each bar and positions (n + 1, 2) [m] of a chain between two points, by force polygon.

    Bars (n,) have rest lengths [m] and stiffness E A [N]; the n - 1 nodes between have weights [N]. The horizontal
    force H is the same in all bars, the vertical ones differ by the weights: two unknowns, closed by two lengths.
    """
    drops = np.concatenate([[0.0], np.cumsum(weights)])

    def bars(unknown):
        horizontal, vertical = unknown
        forces = np.stack([np.full(len(drops), horizontal), vertical + drops], axis=1)
        tension = np.linalg.norm(forces, axis=1)
        return tension, forces / tension[:, None] * (rest * (1.0 + tension / stiffness + expansion))[:, None]

    total, end = float(np.sum(weights)), np.array([span, height])
    forces = np.array([0.5 * total, -0.5 * total])
    for _ in range(200):  # Newton's method by differences: the end moves with the stiffness of the chain
        miss = bars(forces)[1].sum(axis=0) - end
        steps = 1e-6 * np.abs(forces).max() * np.eye(2)
        slope = np.stack([(bars(forces + s)[1] - bars(forces - s)[1]).sum(axis=0) / (2.0 * s.sum()) for s in steps], 1)
        change = np.linalg.solve(slope, -miss)
        forces = forces + change * min(1.0, 0.5 * forces[0] / max(abs(change[0]), 1e-300))
    tension, ways = bars(forces)
    assert np.abs(ways.sum(axis=0) - (span, height)).max() < 1e-9 * span
    return tension, np.concatenate([np.zeros((1, 2)), np.cumsum(ways, axis=0)])


def elastic_catenary(span, length, weight, stiffness, expansion=0.0):
    """Sag [m] of an elastic cable between two points at one height (Irvine 1981): ``weight`` [N] of the whole.

    A piece ds of the unstressed, cold ``length`` L [m] is (1 + T/(E A) + expansion) ds long. With H the horizontal
    tension, the span is H L/(E A) + 2 (1 + expansion) H L/W asinh(W/(2 H)), the sag
    W L/(8 E A) + (1 + expansion) H L/W (sqrt(1 + (W/(2 H))^2) - 1).
    """
    hot = length * (1.0 + expansion)

    def excess(h):
        return h * length / stiffness + 2.0 * h * hot / weight * np.arcsinh(weight / (2.0 * h)) - span

    low, high = 1e-3 * weight, 1e6 * weight
    while high - low > 1e-14 * high:
        middle = np.sqrt(low * high)
        if not low < middle < high:
            break
        low, high = (middle, high) if excess(middle) < 0.0 else (low, middle)
    h = high
    slope = weight / (2.0 * h)
    return weight * length / (8.0 * stiffness) + h * hot / weight * (np.sqrt(1.0 + slope * slope) - 1.0)


def heavy_cable(elements=40, **static):
    """A cable of steel wires, straight and without stress at rest, 325 m long between two points (SSNL114)."""
    return {
        "mesh": {"generator": "rod", "length": 325.0, "elements": elements},
        "node_set": {
            "ends": {"indices": [0, elements]},
            "middle": {"indices": [elements // 2]},
            "all": {"all": True},
        },
        "material": {"wire": {"young_modulus": 5.7e10, "density": 2844.23, "thermal_expansion": 2.3e-5}},
        "section": {"cable": {"area": 2.2783e-4, "material": "wire"}},
        "support": [{"node_set": "ends", "fix": "xyz"}],
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "static": {"method": "relaxation", **static},
        "output": {"probe": [{"name": "all", "node_set": "all"}, {"name": "ends", "node_set": "ends"}]},
    }


def run(data, comm, folder):
    """Run a case to its end; the last row of its history, the same on all ranks, and the last positions. Collective."""
    case = data if isinstance(data, Case) else Case.from_dict(data, source="case.toml", folder=folder.parent)
    with Simulation(case, comm, output=folder, quiet=True) as simulation:
        assert simulation.run() == 0
    found = None
    if comm.rank == 0:
        result = open_result(folder)
        found = {name: values[-1] for name, values in result.history.items()}, result.positions(-1)
    return comm.bcast(found)


def chain(folder, comm, points, forces=(), fixed=(0, -1), gravity=None, **tables):
    """A chain of bars through points, with forces [N] down at the inner ones."""
    n = len(points)
    ends = [k % n for k in fixed]
    loads = {k + 1: force for k, force in enumerate(forces) if force}
    tables = {
        "node_set": {"ends": {"indices": ends}, "all": {"all": True}} | {f"at{k}": {"indices": [k]} for k in range(n)},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "support": [{"node_set": "ends", "fix": "xyz"}],
        "load": [{"node_set": f"at{k}", "force": [0.0, 0.0, -force]} for k, force in loads.items()],
        "static": {"method": "relaxation"},
        "output": {"probe": [{"name": "ends", "node_set": "ends"}, {"name": "all", "node_set": "all"}]},
        **({"gravity": {"acceleration": [0.0, 0.0, gravity]}} if gravity else {}),
    } | tables
    return case_of(folder, comm, points, [[k, k + 1] for k in range(n - 1)], **tables)


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
