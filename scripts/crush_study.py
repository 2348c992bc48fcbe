"""Crushed lattices of bars that touch: the tables of docs/contact_tables.md, checked by arithmetic of its own.

    python scripts/crush_study.py                # all tables, in ten minutes, into the document
    python scripts/crush_study.py passages shock # these only, printed

passages    Pairs of bars whose axes pass through each other between two snapshots, counted over all pairs and all
            snapshots by numpy alone, with and without [self_contact]. Between snapshots nodes move on straight lines:
            the times at which four ends lie in a plane are roots of a cubic, and the axes intersect then or not.
curve       Stress over strain, free and in a smooth box, with and without [self_contact]: plateau, densification.
stiffness   The same curve with contacts of a third and of three times their stiffness.
shock       The stress at a plate that hits the lattice in the box, over the square of its speed.
"""

from __future__ import annotations

import argparse
import copy
import tempfile
import tomllib
from typing import Any

import numpy as np
from mpi4py import MPI
from pages import insert, markdown

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.case.toml import built_in_path, read_text
from pfem_petsc.post.crush import CrushTest, crush

MARKS = {
    "passages": ("<!-- table: scripts/crush_study.py passages -->\n", "<!-- end of passages -->"),
    "curve": ("<!-- table: scripts/crush_study.py curve -->\n", "<!-- end of curve -->"),
    "stiffness": ("<!-- table: scripts/crush_study.py stiffness -->\n", "<!-- end of stiffness -->"),
    "shock": ("<!-- table: scripts/crush_study.py shock -->\n", "<!-- end of shock -->"),
}
SIDE, GAP = 0.04, 2.5e-4
RADIUS = np.sqrt(1.4731e-6 / np.pi)
SPEEDS = 50.0, 65.0, 80.0, 95.0, 110.0
SOFT = 10e6
"""Yield stress for the shocks [Pa], which then form at speeds at which bars do not overlap by more than their radii."""
STEPS = 50  # between snapshots in which passages are counted


def tables(box: bool = False, contact: bool = True, **time: Any) -> dict[str, Any]:
    """Return the tables of ``lattice_crush``, in a smooth ``box``, with and without contact between bars."""
    case = tomllib.loads(read_text(built_in_path("lattice_crush")))
    case["time"].update(time)
    if not contact:
        del case["self_contact"]
    for axis, side in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)) if box else ():
        normal, point = np.zeros(3), np.zeros(3)
        normal[axis], point[axis] = side, -GAP if side > 0.0 else SIDE + GAP
        name = f"{'xy'[axis]}_{'lower' if side > 0.0 else 'upper'}"
        case["wall"].append({"name": name, "type": "plane", "point": point.tolist(), "normal": normal.tolist()})
    return case


def simulate(case: dict[str, Any], folder: str, stiffness: float = 1.0) -> Any:
    """Run a case, with contacts that are stiffer by a factor, and return its result."""
    with Simulation(Case(copy.deepcopy(case)), MPI.COMM_SELF, output=folder, quiet=True) as simulation:
        if stiffness != 1.0:
            simulation.model.self_contact._directory[:, 3] *= stiffness
        simulation.run()
    return open_result(folder)


def curve_of(result: Any, height: float = SIDE) -> CrushTest:
    """Return the crush test of the plate."""
    return crush(result, "plate", area=SIDE**2, height=height)


def distances(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the distances (m,) of segments a-b and c-d, (m, 3): the least of that of four ends from the other segment,
    and of that of the lines where their closest points lie within both."""

    def from_point(p: np.ndarray, one: np.ndarray, two: np.ndarray) -> np.ndarray:
        axis = two - one
        along = np.clip(np.einsum("mi,mi->m", p - one, axis) / np.einsum("mi,mi->m", axis, axis), 0.0, 1.0)
        return np.linalg.norm(p - one - along[:, None] * axis, axis=1)

    least = np.min([from_point(a, c, d), from_point(b, c, d), from_point(c, a, b), from_point(d, a, b)], axis=0)
    s, t, normal = feet(a, b, c, d)
    size = np.linalg.norm(normal, axis=1)
    inside = (size > 0.0) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    apart = np.abs(np.einsum("mi,mi->m", c - a, normal)) / np.where(size > 0.0, size, 1.0)
    return np.where(inside, np.minimum(apart, least), least)


def feet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the parameters of the closest points of two lines, and the product of their axes."""
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    square = np.einsum("mi,mi->m", normal, normal)
    square = np.where(square > 0.0, square, np.inf)
    s = np.einsum("mi,mi->m", np.cross(w, v), normal) / square
    t = np.einsum("mi,mi->m", np.cross(w, u), normal) / square
    return s, t, normal


def intersections(before: np.ndarray, after: np.ndarray) -> int:
    """Return how many pairs with ends at (m, 4, 3) have axes that intersect while ends move on straight lines."""

    def at(time: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return before[rows] + time[:, None, None] * (after - before)[rows]

    def volume(time: np.ndarray, rows: np.ndarray) -> np.ndarray:
        x = at(time, rows)
        return np.einsum("mi,mi->m", x[:, 2] - x[:, 0], np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2]))

    places, everyone = np.linspace(0.0, 1.0, 17), np.arange(len(before))
    values = np.array([volume(np.full(len(before), place), everyone) for place in places])
    met = np.zeros(len(before), dtype=bool)
    for low, high, one, two in zip(places, places[1:], values, values[1:], strict=False):
        rows = np.flatnonzero(one * two <= 0.0)
        start, end = np.full(len(rows), low), np.full(len(rows), high)
        for _ in range(40):
            middle = 0.5 * (start + end)
            same = volume(middle, rows) * one[rows] > 0.0
            start, end = np.where(same, middle, start), np.where(same, end, middle)
        x = at(start, rows)
        s, t, _ = feet(x[:, 0], x[:, 1], x[:, 2], x[:, 3])
        met[rows] |= (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    return int(met.sum())


def count_passages(result: Any, radius: float = RADIUS) -> tuple[int, float, int]:
    """Return the passages, the least distance of two axes over the sum of their radii, and the pairs, of a result."""
    bars = result.bars
    first, second = np.triu_indices(len(bars), 1)
    share = (bars[first][:, :, None] == bars[second][:, None, :]).any(axis=(1, 2))
    one, other = first[~share], second[~share]
    ends = np.hstack([bars[one], bars[other]])
    mesh = result.positions(0)
    reach = np.minimum(2.0 * radius, distances(*(mesh[ends[:, k]] for k in range(4))))
    passages, least, last = 0, np.inf, mesh
    for i in range(1, len(result.times)):
        x = result.positions(i)
        middle = 0.5 * x[bars].sum(axis=1)
        away = middle[one] - middle[other]
        longest = np.linalg.norm(x[bars[:, 1]] - x[bars[:, 0]], axis=1).max()
        way = 2.0 * np.linalg.norm(x - last, axis=1).max()
        near = np.flatnonzero(np.einsum("mi,mi->m", away, away) < (longest + 2.0 * radius + way) ** 2)
        apart = distances(*(x[ends[near, k]] for k in range(4)))
        least = min(least, float((apart / reach[near]).min()))
        close = near[apart < 2.0 * radius + way]
        passages += intersections(last[ends[close]], x[ends[close]])
        last = x
    return passages, least, len(ends)


def passages() -> str:
    """The table of passages."""
    rows = []
    for box in (False, True):
        for contact in (True, False):
            case = tables(box, contact)
            case["output"].update(fields_every=STEPS, fields=[], precision="float64")
            with tempfile.TemporaryDirectory() as folder:
                result = simulate(case, folder)
                count, least, pairs = count_passages(result)
                overlap = f"{100.0 * result.history['self_contact/overlap'].max() / RADIUS:.1f} %" if contact else "-"
                rows.append(
                    [_name(box, contact), f"{len(result.times)}", f"{pairs:,}", f"{count:,}", f"{least:.3f}", overlap]
                )
                print(rows[-1], flush=True)
    head = "lattice", "snapshots", "pairs", "passages of axes", "least distance over R", "overlap over radius"
    return markdown(head, rows)


def _name(box: bool, contact: bool) -> str:
    return ("in a box" if box else "free") + ("" if contact else ", without `[self_contact]`")


def curve() -> str:
    """The table of stresses."""
    strains = 0.1, 0.3, 0.5, 0.6, 0.65, 0.7, 0.75
    rows = []
    for box in (False, True):
        for contact in (True, False):
            with tempfile.TemporaryDirectory() as folder:
                result = simulate(tables(box, contact, end=6.1e-3, safety=0.2), folder)
                history, test = result.history, curve_of(result)
                value = dict(zip(test.figures()["figure"], test.figures()["value"], strict=True))
                stress = [f"{np.interp(strain, test.strain, test.stress) / 1e6:.2f}" for strain in strains]
                dense = value["densification strain"]
                balance = abs(history["energy_imbalance"]).max() / history["contact_work"][-1]
                motion = history["kinetic_energy"].max() / history["contact_work"][-1]
                print(_name(box, contact), f"balance {balance:.1e}, kinetic energy over work {motion:.1%}", flush=True)
                rows.append([_name(box, contact), *stress, f"{dense:.3f}" if np.isfinite(dense) else "-"])
                print(rows[-1], flush=True)
    return markdown(["stress [MPa] at strain", *(f"{strain:g}" for strain in strains), "densification"], rows)


def stiffness() -> str:
    """The table of the stiffness of contacts."""
    factors, strains, tests = (0.316, 1.0, 3.16), (0.4, 0.5, 0.6, 0.65), []
    overlaps = []
    for factor in factors:
        with tempfile.TemporaryDirectory() as folder:
            result = simulate(tables(True, safety=0.05), folder, factor)
            tests.append(curve_of(result))
            overlaps.append(result.history["self_contact/overlap"].max() / RADIUS)
    rows = []
    for factor, test, overlap in zip(factors, tests, overlaps, strict=True):
        energy = [f"{test.energy_to(strain) / 1e6:.4f}" for strain in strains]
        apart = max(abs(test.energy_to(strain) / tests[1].energy_to(strain) - 1.0) for strain in strains)
        rows.append([f"{factor:g}", *energy, f"{100.0 * apart:.2f} %", f"{100.0 * overlap:.1f} %"])
        print(rows[-1], flush=True)
    head = (
        "stiffness",
        *(f"energy to {strain:g} [MJ/m³]" for strain in strains),
        "largest deviation",
        "overlap over radius",
    )
    return markdown(head, rows)


def shock() -> str:
    """The table of the stress of a shock over the speed, and the line through it."""
    cells, rows, stresses = 10, [], []
    for speed in SPEEDS:
        case = tables(True, end=0.6 * cells * 0.01 / speed, safety=0.1)
        case["mesh"]["cells"] = [4, 4, cells]
        case["material"]["aluminium"].update(yield_stress=SOFT, isotropic_hardening=7.0 * SOFT)
        plate = case["wall"][1]
        plate["point"], plate["velocity"] = [0.0, 0.0, cells * 0.01 + GAP], [0.0, 0.0, -speed]
        case["output"]["history_every"] = 5
        with tempfile.TemporaryDirectory() as folder:
            result = simulate(case, folder)
            test = curve_of(result, cells * 0.01)
            front = _strain_behind(result, speed)
            overlap = result.history["self_contact/overlap"].max() / RADIUS
            mass = test.mass / (SIDE**2 * cells * 0.01)
        stress = (test.energy_to(0.5) - test.energy_to(0.15)) / 0.35
        stresses.append(stress)
        rows.append(
            [
                f"{speed:g}",
                f"{stress / 1e6:.2f}",
                f"{front:.3f}",
                f"{mass * speed**2 / front / 1e6:.2f}",
                f"{100.0 * overlap:.0f} %",
            ]
        )
        print(rows[-1], flush=True)
    squares = np.square(SPEEDS)
    slope, constant = np.polyfit(squares, stresses, 1)
    error = np.abs(np.polyval([slope, constant], squares) / stresses - 1.0).max()
    print(f"slope {slope:.0f} kg/m3: locking strain {mass / slope:.3f}, stress at rest {constant / 1e6:.2f} MPa")
    head = (
        "speed V [m/s]",
        "stress at the plate [MPa]",
        "strain ε behind the front",
        "ρ₀ V²/ε [MPa]",
        "overlap over radius",
    )
    text = (
        f"A line through the stresses over V² has the slope {slope:.0f} kg/m³ = ρ₀/{mass / slope:.3f}, with ρ₀ = "
        f"{mass:.0f} kg/m³,\nand {constant / 1e6:.1f} MPa at V = 0; it is within {100.0 * error:.1f} % of them."
    )
    return markdown(head, rows) + "\n\n" + text


def _strain_behind(result: Any, speed: float) -> float:
    """Return the mean strain along z of the nodes that move with the plate, when it has gone 45 % of the height."""
    mesh = result.positions(0)
    height = np.ptp(mesh[:, 2])
    at = int(np.argmin(np.abs(speed * result.times - 0.45 * height)))
    x, v = result.positions(at), (result.positions(at) - result.positions(at - 1))[:, 2]
    v = v / (result.times[at] - result.times[at - 1])
    crushed = (v < -0.9 * speed) & (mesh[:, 2] > 0.1 * height)
    slope = np.polyfit(mesh[crushed, 2], x[crushed, 2], 1)[0]
    return 1.0 - slope


TABLES = {function.__name__: function for function in (passages, curve, stiffness, shock)}


def main() -> None:
    """Make the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", nargs="*", metavar="TABLE", help=", ".join(TABLES))
    which = parser.parse_args().which
    for name in which or TABLES:
        text = TABLES[name]()
        print(text, flush=True)
        if not which:
            insert("contact_tables.md", *MARKS[name], text + "\n")


if __name__ == "__main__":
    main()
