"""The tables of moving walls in docs/contact_tables.md: their work, the energy balance, and impacts seen from the wall.

    python scripts/moving_walls.py           # rewrites them, in a quarter of an hour
    python scripts/moving_walls.py --others  # the one of triangles and a plane that turns, in three minutes

Bodies hit walls of constant velocity V, and walls with mass: every integrator, treatment and restitution 0, 1/2 and 1,
at a plane, a rough plane, a sphere, a plate with mass, triangles and a plane that turns about a far centre, by a bar
that falls flat, a rod that falls on its end and a lattice that tumbles. Each runs a second time as seen from the wall:
the body has the velocity of the first run less V, and the wall rests. Both must have the same motion, impacts and
dissipations, and the wall has done the work V . (impulse + jump_impulse) in the first. The errors of these are relative
to the energy of the motion.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from impact_phases import label
from mpi4py import MPI
from pages import insert, markdown

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

START, END = "<!-- table: scripts/moving_walls.py -->\n", "<!-- end of moving walls -->"
START_OTHERS, END_OTHERS = "<!-- table: scripts/moving_walls.py --others -->\n", "<!-- end of other moving walls -->"
SCHEMES = (
    *(("central_differences", {}), ("chung_lee", {}), ("hulbert_chung", {}), ("souza_moura", {}), ("noh_bathe", {})),
    *(("newmark", {}), ("newmark", {"beta": 0.25, "gamma": 0.5}), ("houbolt", {})),
    *(("wilson", {"theta": 1.4}), ("wilson", {"theta": 2.0}), ("generalized_alpha", {})),
    *(("hht_alpha", {}), ("bathe", {}), ("energy_momentum", {})),
)
TREATMENTS = "scheme", "stick", "conserving", "mass_redistribution"
RESTITUTIONS = 0.0, 0.5, 1.0
MOTION, VELOCITY = np.array([0.2, -0.1, 0.3]), np.array([0.1, 0.3, -1.0])
"""Of the wall, and of the body as seen from it [m/s]."""
GAP = 0.0133  # [m]
DISSIPATIONS = tuple(f"{kind}_dissipation" for kind in ("impact", "friction", "numerical"))

_FLAT = {"points": [[-0.2, 0.0, GAP], [0.3, 0.1, GAP]], "bars": [[0, 1]]}
_UPRIGHT = {"points": [[0.0, 0.0, GAP + 0.1 * k] for k in range(6)], "bars": [[k, k + 1] for k in range(5)]}
BODIES = {
    "node": ({"generator": "arrays", **_FLAT}, 1e-3, 1e-3, 0.02),
    "rod": ({"generator": "arrays", **_UPRIGHT}, 1e-3, 1e-3, 0.05),
    "truss": ({"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 0.1}, 1e-5, 4e-4, 0.024),
}
"""Mesh, area [m2], step and end [s]."""
PLATE = 0.1  # [kg]
WALLS = {
    "plane": {},
    "rough": {"friction": 0.3},
    "sphere": {"type": "sphere", "radius": 0.5},
    "plate": {"mass": PLATE},
    "triangles": {"friction": 0.3},
    "turning": {"friction": 0.3},
}
OTHERS = "triangles", "turning"
"""Walls with a table of their own, of :data:`SOME` integrators."""
SOME = (
    *(("central_differences", {}), ("chung_lee", {}), ("newmark", {"beta": 0.25, "gamma": 0.5})),
    *(("generalized_alpha", {}), ("energy_momentum", {})),
)
FAR = 1e6
"""Distance of the centre of rotation [m]: the wall moves along an arc that is straight to 1e-7 of the motion."""


class Errors(NamedTuple):
    """Of a run: of the work of the wall, the energy balance, and the energies as seen from the wall, over the energy of
    the motion; and of momentum, of the body and of a plate, over that of the motion."""

    work: float
    balance: float
    frames: float
    momentum: float


def motion_of(wall: str, motion: np.ndarray) -> dict:
    """Return the keys of a wall that moves with a ``motion`` (3,) [m/s]."""
    if wall != "turning":
        return {"velocity": motion.tolist()}
    speed = float(np.linalg.norm(motion))
    axis = np.cross(motion, [0.0, 0.0, 1.0])
    centre = FAR * np.cross(axis / np.linalg.norm(axis), motion / speed)
    return {"rotation": {"centre": centre.tolist(), "axis": axis.tolist(), "angular_velocity": speed / FAR}}


def write_triangles(file: Path, point: np.ndarray, normal: np.ndarray) -> None:
    """Write a square of two triangles in a plane."""
    one = np.cross(normal, [0.3, 0.8, 0.5])
    other = np.cross(normal, one) / np.linalg.norm(normal)
    corners = point + 50.0 * np.array([one, other, -one, -other])
    file.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist()) + "f 1 2 3\nf 1 3 4\n")


def case_of(
    scheme: tuple[str, dict], treatment: str, restitution: float, wall: str, body: str, motion: np.ndarray, folder: Path
) -> Case:
    """Return the case with the ``motion`` (3,) of the wall [m/s]; ``folder`` for the file of a surface."""
    mesh, area, step, end = BODIES[body]
    integrator, parameters = scheme
    upright = body == "rod" or (body == "truss" and treatment == "mass_redistribution")  # nodes that cannot pass others
    low = -GAP if body == "truss" else 0.0
    keys = {"name": "wall", "type": "plane", "node_set": "low" if upright else "all", "restitution": restitution}
    if wall == "sphere":
        # under the middle of the bar that falls flat, beside the end of the rod
        keys["point"] = [0.05, 0.05, low - 0.43] if body == "node" else [0.03, 0.02, low - 0.5]
    else:
        keys |= {"point": [0.0, 0.0, low], "normal": [0.1, 0.05, 1.0] if body == "truss" else [0.0, 0.0, 1.0]}
    if wall == "triangles":
        write_triangles(folder / "face.obj", np.array(keys.pop("point")), np.array(keys.pop("normal")))
        keys |= {"type": "surface", "file": str(folder / "face.obj")}
    if motion.any() or wall == "plate":
        keys |= motion_of(wall, motion)
    spin = [3.0, -2.0, 1.0] if body == "truss" else [0.0, 0.0, 0.0]
    return Case.from_dict(
        {
            "mesh": mesh,
            "node_set": {"all": {"all": True}, "low": {"box": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.5 * GAP]]}},
            "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"s": {"area": area, "material": "m"}},
            "initial": {"velocity": (VELOCITY + motion).tolist(), "angular_velocity": spin},
            "wall": [keys | WALLS[wall]],
            "contact": {"treatment": treatment},
            "time": {"integrator": integrator, "step": step, "end": end, **parameters},
            "solver": {"rtol": 1e-14, "linear": "mumps"},
            "output": {"fields_every": 0},
        }
    )


def errors_of(scheme: tuple[str, dict], treatment: str, restitution: float, wall: str, body: str) -> Errors:
    """Run an impact with a wall that moves, and as seen from the wall.

    Raises
    ------
    InputError
        If the program refuses the combination.
    """
    rows = []
    for motion in (MOTION, np.zeros(3)):
        with tempfile.TemporaryDirectory() as folder:
            case = case_of(scheme, treatment, restitution, wall, body, motion, Path(folder))
            run = Simulation(case, MPI.COMM_SELF, output=folder, quiet=True)
            rows.append([step.row for step in run])
    moving, seen = rows[0][-1], rows[1][-1]
    mass = run.model.total_mass
    assert max(row["active_contacts"] for row in rows[0]) > 0, "the body misses the wall"
    energy = 0.5 * mass * (np.linalg.norm(MOTION) + np.linalg.norm(VELOCITY)) ** 2
    given = moving["wall/wall/impulse"] + moving["wall/wall/jump_impulse"]
    lost = moving["momentum"] - seen["momentum"] - mass * MOTION
    if treatment != "mass_redistribution":  # whose masses do not have the momentum of a spin
        lost = np.append(lost, moving["momentum"] - mass * (VELOCITY + MOTION) - given)
    if wall == "plate":
        lost = np.append(lost, PLATE * (moving["wall/wall/velocity"] - MOTION) + given)
    expected = 0.0 if wall == "plate" else MOTION @ given
    apart = [abs(moving[name] - seen[name]) for name in (*DISSIPATIONS, "elastic_energy")]
    return Errors(
        abs(moving["contact_work"] - expected) / energy,
        max(abs(row["energy_imbalance"]) for each in rows for row in each) / energy,
        max(apart) / energy,
        np.abs(lost).max() / (mass * np.linalg.norm(VELOCITY)),
    )


def worst(combinations: Iterable[tuple]) -> str:
    """Return how many of these are not refused, and their largest errors."""
    found = []
    for combination in combinations:
        try:
            found.append(errors_of(*combination))
        except InputError:
            continue
    return f"{len(found)}: " + ", ".join(f"{error:.0e}" for error in np.max(found, axis=0)) if found else "-"


def table() -> str:
    """The table: of each integrator and treatment the largest errors over restitutions, walls and bodies."""
    rows, walls = [], [name for name in WALLS if name not in OTHERS]
    for scheme in SCHEMES:
        cells = [
            worst(itertools.product([scheme], [treatment], RESTITUTIONS, walls, BODIES)) for treatment in TREATMENTS
        ]
        print(label(*scheme), *cells, sep="  ", flush=True)
        rows.append([label(*scheme), *cells])
    return markdown(["integrator", *(f"`{treatment}`" for treatment in TREATMENTS)], rows)


def other_table() -> str:
    """The table of triangles and of a plane that turns, of some integrators with all treatments together."""
    rows = []
    for scheme in SOME:
        cells = [worst(itertools.product([scheme], TREATMENTS, RESTITUTIONS, [wall], BODIES)) for wall in OTHERS]
        print(label(*scheme), *cells, sep="  ", flush=True)
        rows.append([label(*scheme), *cells])
    return markdown(["integrator", *OTHERS], rows)


def main() -> None:
    """Run everything, and insert the table between its marks in the document."""
    insert("contact_tables.md", START_OTHERS, END_OTHERS, other_table() + "\n")
    if "--others" not in sys.argv[1:]:
        insert("contact_tables.md", START, END, table() + "\n")


if __name__ == "__main__":
    main()
