"""The table of friction in docs/contact_tables.md: errors of the velocity that particles keep along a wall.

    python scripts/friction_scan.py  # rewrites it, in about four minutes

One node of a very soft bar is a particle that meets a wall with v_n = 2 v_t, at each of twelve phases of the impact
within a step: in the plane, at a wall at rest; and in space, at an oblique wall that moves. Its velocity along and
relative to the wall is then v_t - min(mu (1 + e) v_n, v_t) in the direction of v_t, also for walls with mass. The wall
is a plane, a surface of triangles, a plane that turns about a far centre, or an equal particle of a contact pair.
"""

from __future__ import annotations

import itertools
import re
import tempfile
from pathlib import Path

import numpy as np
from impact_phases import SCHEMES, label
from mpi4py import MPI
from pages import insert, markdown

from pfem_petsc import Case
from pfem_petsc.errors import InputError
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan, make_stepper

START, END = "<!-- table: scripts/friction_scan.py -->\n", "<!-- end of friction -->"
PHASES, BEFORE, STEPS, LAST = 12, 3, 12, 4  # steps before the impact, of the run, and that are compared
STEP, APPROACH, SLIP = 1e-3, 6.0, 3.0  # [s], [m/s]
FRICTIONS = 0.0, 0.2, 0.9  # with e = 0 the second leaves 0.6 of v_t, the third nothing
KINDS = {
    "`scheme`": ("scheme", {}),
    "`stick`": ("stick", {}),
    "`conserving`": ("conserving", {}),
    "`mass_redistribution`": ("mass_redistribution", {}),
    "`scheme`, wall with mass": ("scheme", {"mass": 0.5}),  # that of the node
    "`scheme`, e = 1/2": ("scheme", {"restitution": 0.5}),
    "`scheme`, triangles": ("scheme", {"type": "surface"}),
    "`scheme`, turning": ("scheme", {"type": "turning"}),
    "`scheme`, pair": ("scheme", {"type": "pair"}),
}
EXACT = 1e-8
"""Relative errors below this are shown as 0: those of the solver, and of the stiffness of the bars."""
FAR, OF_TURN = 1e6, 1e-5
"""Distance of the centre of rotation [m], and what is shown as 0 then: motion along an arc is no straight one."""


def source_of(case: dict, wall: dict, n: np.ndarray, motion: np.ndarray, folder: Path) -> dict:
    """Return the tables of what the particles meet, a surface through the origin with the normal n and this ``motion``
    (3,) [m/s]; add the partners of a pair to the mesh of the case."""
    kind, keys = wall.get("type", "plane"), {key: value for key, value in wall.items() if key != "type"}
    if kind == "pair":
        mesh, tips = case["mesh"], list(range(0, 2 * PHASES, 2))
        ends = np.array(mesh["points"])
        feet = ends[tips] - np.outer(ends[tips] @ n, n)
        mesh["points"] += np.stack([feet, feet - n], axis=1).reshape(-1, 3).tolist()
        mesh["bars"] = np.arange(4 * PHASES).reshape(-1, 2).tolist()
        case["node_set"]["partners"] = {"indices": [2 * PHASES + k for k in tips]}
        case["node_set"]["second"] = {"indices": list(range(2 * PHASES, 4 * PHASES))}
        case["initial"]["on"] = [{"node_set": "second", "velocity": motion.tolist()}]
        pair = {"name": "pair", "first": "partners", "second": "tips", "direction": n.tolist()}
        return {"contact_pair": [pair | keys]}
    at = list(case["node_set"])[:PHASES] if "mass" in wall else ["tips"]  # each node moves its own wall with mass
    keys |= {"type": "plane", "point": [0.0] * 3, "normal": n.tolist()}
    if kind == "surface":
        across = 1e3 * np.cross(n, [0.2, 0.3, 0.1])
        corners = np.array([across, np.cross(n, across), -across, -np.cross(n, across)])
        file = folder / "face.obj"
        file.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist()) + "f 1 2 3\nf 1 3 4\n")
        keys = {key: value for key, value in keys.items() if key not in ("point", "normal")}
        keys |= {"type": "surface", "file": str(file)}
    if motion.any() and kind == "turning":
        axis = np.cross(n, motion)
        arm = FAR * np.cross(axis, motion)
        centre = arm / np.linalg.norm(axis) / np.linalg.norm(motion)
        rate = np.linalg.norm(motion) / FAR
        keys["rotation"] = {"centre": centre.tolist(), "axis": axis.tolist(), "angular_velocity": rate}
    elif motion.any():
        keys["velocity"] = motion.tolist()
    return {"wall": [keys | {"name": f"at {name}", "node_set": name} for name in at]}


def case_of(
    integrator: str, parameters: dict, treatment: str, wall: dict, space: bool, folder: Path
) -> tuple[dict, np.ndarray, np.ndarray]:
    """Return a case, the normal and the direction of v_t; in ``space`` or in the plane y = 0."""
    n = np.array([0.3, -0.5, 0.8] if space else [0.0, 0.0, 1.0])
    n /= np.linalg.norm(n)
    t = np.cross(n, [0.3, 0.8, 0.5]) if space else np.array([1.0, 0.0, 0.0])
    t /= np.linalg.norm(t)
    along = 0.8 * t - 0.6 * np.cross(n, t) if space else t
    motion = np.array([1.0, 2.0, -0.5]) if space else np.zeros(3)
    gaps = APPROACH * STEP * (BEFORE + (np.arange(PHASES) + 0.5) / PHASES)
    points = np.array([gap * n + 3.0 * k * t + end * n for k, gap in enumerate(gaps) for end in (0.0, 1.0)])
    sets = {f"node{k}": {"indices": [2 * k]} for k in range(PHASES)}
    sets |= {"tips": {"indices": list(range(0, 2 * PHASES, 2))}, "all": {"all": True}}
    case = {
        "mesh": {
            "generator": "arrays",
            "points": points.tolist(),
            "bars": np.arange(2 * PHASES).reshape(-1, 2).tolist(),
        },
        "node_set": sets,
        "support": [] if space else [{"node_set": "all", "fix": "y"}],
        "material": {"m": {"young_modulus": 1e-3, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "initial": {"velocity": (SLIP * along - APPROACH * n + motion).tolist()},
        "contact": {"treatment": treatment},
        "time": {"integrator": integrator, "step": STEP, "end": 1.0, **parameters},
        "solver": {"linear": "mumps", "rtol": 1e-12},
    }
    return case | source_of(case, wall, n, motion, folder), n, along


def error_of(integrator: str, parameters: dict, treatment: str, wall: dict) -> float:
    """Return the largest error of the velocity along the wall after the impact, of all phases, over v_t.

    Raises
    ------
    InputError
        If the program refuses the combination.
    """
    largest = 0.0
    left = max(SLIP - wall["friction"] * (1.0 + wall.get("restitution", 0.0)) * APPROACH, 0.0)
    for space in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            case, n, along = case_of(integrator, parameters, treatment, wall, space, Path(folder))
            model = Model(Case.from_dict(case), MPI.COMM_SELF)
        stepper = make_stepper(model, make_plan(model))
        nodes = np.argsort(model.mesh.node_ids)
        tips = nodes[: 2 * PHASES : 2]
        stepper.start()
        for k in range(STEPS):
            stepper.step()
            if stepper.fault is not None:
                raise stepper.fault
            if k >= STEPS - LAST:
                x, v, motion = stepper.state.position[tips], stepper.state.v[tips], model.contact.motion
                if wall.get("type") == "pair":
                    v = v - stepper.state.v[nodes[2 * PHASES :: 2]]
                else:
                    wall_of = np.arange(PHASES) if "mass" in wall else 0  # each node has its own wall with mass
                    v = v - motion.rates_at(x, stepper.state.time)[np.arange(PHASES), wall_of]
                    v = v @ motion.poses(stepper.state.time).turns[0] if motion.turning.any() else v
                v -= (v @ n)[:, None] * n
                largest = max(largest, np.linalg.norm(v - left * along, axis=1).max())
        if hasattr(stepper, "destroy"):
            stepper.destroy()
    return largest / SLIP


def reason_of(error: InputError) -> str:
    """Return why a combination is refused: the message without the place that it names first."""
    return re.sub(
        r"^case: (contact\.treatment = \"\w+\"( with time\.integrator = \"\w+\")?|(wall|contact_pair) '[^']*'): ",
        "",
        str(error),
    )


def lines(schemes: tuple = SCHEMES) -> list[str]:
    """Return the rows of the table, and a list of the reasons for which combinations are refused."""
    columns = [(name, friction) for name in KINDS for friction in FRICTIONS]
    reasons: list[str] = []
    cells = {column: [] for column in columns}
    for (name, friction), (integrator, parameters) in itertools.product(columns, schemes):
        treatment, wall = KINDS[name]
        try:
            error = error_of(integrator, parameters, treatment, wall | {"friction": friction})
            exact = OF_TURN if wall.get("type") == "turning" else EXACT
            cells[name, friction].append(f"{error:.2f}" if error > exact else "0")
        except InputError as refused:
            reason = reason_of(refused)
            reasons += [] if reason in reasons else [reason]
            cells[name, friction].append(f"({reasons.index(reason) + 1})")
    shown = [column for column in columns if not all(cell.startswith("(") for cell in cells[column])]
    rows = [[label(*scheme), *(cells[column][k] for column in shown)] for k, scheme in enumerate(schemes)]
    rows = markdown(["integrator", *(f"{name}, μ = {friction:g}" for name, friction in shown)], rows).splitlines()
    rows += ["", "Refused, with the reason that the program gives:", ""]
    rows += [f"{k}. {reason}" for k, reason in enumerate(reasons, 1)]
    never = [
        f"{name}, μ = {mu:g}: {', '.join(sorted(set(cells[name, mu])))}"
        for name, mu in columns
        if (name, mu) not in shown
    ]
    return [*rows, "", "With every integrator: " + "; ".join(never) + "."]


def main() -> None:
    """Run everything, and insert the table between its marks in the document."""
    insert("contact_tables.md", START, END, "\n".join(lines()) + "\n")


if __name__ == "__main__":
    main()
