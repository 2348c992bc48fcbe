"""Properties that the results of any valid case with status 0 must have, and the comparison of two results.

Each check returns faults, (cause, detail). Tolerances:

- positions against walls: 1e-9 of the truss's size (1e-6 with float32); `wilson` keeps walls at t + theta h and not at
  the end of the step, so that a node may be as far beyond as it moves in (theta - 1) h, twice at most
- balance of energy: 1e-7 of the largest energy; above 1e-9 it is counted apart
- gain of energy from contact and the scheme without a warning, in the mean over the last quarter of the run: 0.05 of
  what was put in (energy at the start, works of loads and temperature; with walls that move, the largest energy).
  Central differences conserve T + U - h^2/8 a.Ma with velocities in the middle of two half steps: the last term, at
  most (h w/2)^2 U with the highest frequency w, comes and goes, and is no gain; so with the other explicit schemes
- dissipations: 1e-9 of the largest energy below zero; in cases of stages no fall by more than 1e-11
- contact work at walls at rest: with `stick` 1e-3 of the energy input, else 0.05 of it in the last quarter
- momentum: 1e-9 of the largest momentum or impulse, or four times the solver's tolerance
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pyvista as pv
from mpi4py import MPI
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from pfem_petsc import open_result
from pfem_petsc.case.schema import Case
from pfem_petsc.case.tables import Section
from pfem_petsc.contact.walls.base import WallKeys
from pfem_petsc.output.result import Result
from pfem_petsc.post.members import members
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan

from .draw import closed_area, generated, members_of

Faults = list[tuple[str, str]]
_ENDS = ("_energy", "_dissipation", "_work")
LOSSES = ("numerical_dissipation", "impact_dissipation", "friction_dissipation")
NEVER_FALL = (
    "plastic_heat",
    *(f"{kind}_dissipation" for kind in ("damage", "rupture", "viscous", "friction", "damping")),
)
BY_END_VELOCITIES = ("central_differences", "chung_lee", "souza_moura", "noh_bathe")
"""Integrators whose damping works by the velocities at both ends of a step: it gives energy where these point back."""


class Loaded:
    """Everything of a result.

    Attributes
    ----------
    case : Case
    history : column to array (rows, ...)
    steps : (snapshots,)
    positions : (snapshots, nodes, 3) [m]
    fields : name to array (snapshots, nodes or bars, ...)
    """

    def __init__(self, folder: Path) -> None:
        result = open_result(folder)
        self.case: Case = result.case
        self.steps = result.steps
        count = len(result.times)
        with h5py.File(result.path, "r", locking=False) as file:
            rows = result._n_rows
            self.history = {name: file[f"history/{name}"][:rows] for name in result._columns}
            vtk = file["VTKHDF"]
            names = {f"PointData/{name}": result.n_nodes for name in result.point_fields}
            names |= {f"CellData/{name}": result.n_bars for name in result.cell_fields}
            self.fields = {name.partition("/")[2]: _by_snapshot(vtk[name], count, n) for name, n in names.items()}
            self.positions = _by_snapshot(vtk["Points"], count, result.n_nodes)

    @property
    def size(self) -> float:
        """Largest extent at the start [m]; 1 without snapshots."""
        return float(np.ptp(self.positions[0], axis=0).max()) if len(self.steps) else 1.0


def _by_snapshot(dataset: h5py.Dataset, count: int, rows: int) -> np.ndarray:
    return dataset[: count * rows].reshape(count, rows, *dataset.shape[1:])


def check_result(folder: Path, warned: list[str]) -> Faults:
    """Run all checks of a complete result."""
    result = Loaded(folder)
    case, history = result.case, result.history
    faults = _finite(result)
    if faults:
        return faults
    faults += _sections(case)
    if case.stage:
        faults += _stages(result, case, history) + _momentum(case, history) + _states(folder, result)
        return faults or _members_table(folder, result) or _bar_probes(folder, result)
    faults += _mass(case, history)
    faults += _walls(result, case, history)
    faults += _energy(case, history, warned, result.size)
    faults += _momentum(case, history)
    return faults or _members_table(folder, result) or _bar_probes(folder, result)


_STRAINS = {
    "engineering": lambda stretch: stretch - 1.0,
    "green": lambda stretch: 0.5 * (stretch**2 - 1.0),
    "logarithmic": np.log,
}
_SLOPES = {
    "engineering": np.ones_like,
    "green": lambda strain: np.sqrt(1.0 + 2.0 * strain),
    "logarithmic": lambda strain: np.exp(-strain),
}
"""Of the strain over the stretch: the axial force is the stress times area and slope."""


def _bar_probes(folder: Path, result: Loaded) -> Faults:
    """Check bars of probes: the strain of their lengths, the force of stress and area, and the fields of snapshots."""
    opened, case, faults = open_result(folder), result.case, []
    plain = not any(section.prestressed for stage in case.stages for section in stage.section.values())
    plain &= all(stage.static is None or stage.static.method != "force_density" for stage in case.stages)
    plain &= case.contact.treatment != "mass_redistribution"  # whose massless nodes start in equilibrium, off the mesh
    single = len(case.section) == 1
    (section, *_), rounding = case.section.values(), 1e-6 if case.output.precision == "float32" else 0.0
    for probe in case.output.bar_probe:
        (bar,) = opened.attributes[f"probe_bars/{probe.name}"]
        rows = {name: result.history[f"bar/{probe.name}/{name}"][:, 0] for name in ("strain", "stress", "axial_force")}
        if single and section.uniform_area is not None:
            slope = _SLOPES[case.material[section.material].strain](rows["strain"])
            apart = np.abs(rows["stress"] * section.uniform_area * slope - rows["axial_force"]).max()
            if not apart <= 1e-12 * np.abs(rows["axial_force"]).max():
                faults.append(("bar probe: the force is not that of the stress", f"{apart}"))
        ends = np.diff(result.positions[:, opened.bars[bar]], axis=1)[:, 0]
        lengths = np.linalg.norm(ends, axis=1)
        for i, step in enumerate(result.steps):
            here = np.flatnonzero(result.history["step"] == step)
            if not len(here):
                continue
            for name in rows.keys() & result.fields.keys():
                apart = np.abs(rows[name][here] - result.fields[name][i, bar]).min()
                if not apart <= rounding * np.abs(result.fields[name][i, bar]):
                    faults.append((f"bar probe: {name} is not that of the snapshot", f"step {step}: {apart}"))
            if plain and single and result.steps[0] == 0:
                strain = _STRAINS[case.material[section.material].strain](lengths[i] / lengths[0])
                apart = np.abs(rows["strain"][here] - strain).min()
                reach = np.abs(result.positions).max() / lengths[0]
                if not apart <= 1e-14 * reach + 1e-9 * abs(strain):
                    faults.append(("bar probe: the strain is not that of the length", f"step {step}: {apart}"))
    return faults


def _stages(result: Loaded, case: Case, history: dict[str, np.ndarray]) -> Faults:
    """Check the balance of energy over all stages, and that what is dissipated stays so."""
    scale = energy_scale(history)
    # below: supports that move a mechanism, with forces that are rounding errors of the stiffness
    if not scale > 1e-13 * _strongest(case) * float(np.ptp(result.positions, axis=0).max(initial=0.0)):
        return []
    faults, stages = _open(history), history["stage"].astype(int)
    # load cases begin with what there was at the end of the stage that they start from
    ends = {k: np.flatnonzero(stages == k).max(initial=-1) for k in range(len(case.stage))}
    before = np.arange(len(stages)) - 1
    for k, stage in enumerate(case.stage):
        if stage.starts_from is not None:
            before[np.flatnonzero(stages == k)[:1]] = ends[stage.starts_from]
    before = before[1:]
    may_fall = [stage.time is not None and stage.time.integrator in BY_END_VELOCITIES for stage in case.stage]
    for name in NEVER_FALL:
        falls = history[name][1:] - history[name][before]
        if name == "damping_dissipation":
            falls[np.array(may_fall)[stages[1:]]] = 0.0
        if falls.min(initial=0.0) < -1e-11 * scale:
            stage = stages[falls.argmin() + 1]
            faults.append((f"{name} falls", f"{falls.min() / scale:.3g} of the largest energy, in stage {stage}"))
    return faults


def _open(history: dict[str, np.ndarray]) -> Faults:
    """Check the balance of energy."""
    scale, imbalance = energy_scale(history), np.abs(history["energy_imbalance"])
    if not imbalance.max() > 1e-9 * scale:
        return []
    at = int(history["step"][np.argmax(imbalance > 1e-9 * scale)])
    cause = "energy balance open" if imbalance.max() > 1e-7 * scale else "energy balance above 1e-9"
    return [(cause, f"{imbalance.max() / scale:.3g} of the largest energy, first at step {at}")]


def energy_scale(history: dict[str, np.ndarray]) -> float:
    """Return the largest of all energies, works and dissipations of a run [J]."""
    return max(float(np.abs(column).max()) for name, column in history.items() if name.endswith(_ENDS))


def _finite(result: Loaded) -> Faults:
    for name, values in (result.history | result.fields | {"positions": result.positions}).items():
        if not np.isfinite(values).all():
            return [("not finite", name)]
    return []


def _walls(result: Loaded, case: Case, history: dict[str, np.ndarray]) -> Faults:
    """Check that no node is beyond a wall in a snapshot."""
    faults: Faults = []
    if not len(result.steps) or not case.wall:
        return faults
    start, size = result.positions[0], result.size
    tolerance = (1e-6 if case.output.precision == "float32" else 1e-9) * max(size, float(np.abs(start).max()))
    rows = {int(step): row for row, step in enumerate(history["step"])}
    # supports that prescribe all components of a node carry it where they say: walls do not count
    fixed = np.zeros(start.shape, dtype=bool)
    for support in case.support:
        if support.fix is None or support.frame is not None:
            continue  # no wall stops its nodes
        fixed[np.ix_(_members(case, support.node_set), ["xyz".index(c) for c in support.fix])] = True
    carried = np.flatnonzero(fixed.all(axis=1))
    for wall in case.wall:
        members = np.setdiff1d(_members(case, wall.node_set), carried)
        moved = history.get(f"wall/{wall.name}/position")
        worst = (0.0, "")
        for i, step in enumerate(result.steps):
            row = rows.get(int(step))
            if moved is not None and row is None:
                continue
            at = _seen(wall, result.positions[i][members], history, row)
            depth = -_distances(wall, at)
            if wall.type == "rectangle":
                depth[~_before_rectangle(wall, result, i, members, at, rows)] = 0.0
            if len(depth) and depth.max() > worst[0]:
                worst = (float(depth.max()), f"snapshot {i} of {len(result.steps)}, node {members[depth.argmax()]}")
        if worst[0] > tolerance + _wilson(case, history, result):
            faults.append(("node beyond a wall", f"{wall.name} ({wall.type}) by {worst[0]:.3g} m in {worst[1]}"))
    return faults


def _seen(wall: WallKeys, x: np.ndarray, history: dict[str, np.ndarray], row: int | None) -> np.ndarray:
    """Return where positions (m, 3) at a row of the history are as seen from a wall, which then seems at rest."""
    centre, turn = history.get(f"wall/{wall.name}/position"), wall.rotation
    if centre is None:
        return x
    if wall.inertia is not None:
        free = Rotation.from_rotvec(-history[f"wall/{wall.name}/rotation"][row])
        return free.apply(x - centre[row]) + centre[0]
    if turn is None:
        return x - (centre[row] - centre[0])
    time, angle = history["time"][row], (turn.angular_velocity or 0.0) * history["time"][row]
    if turn.angles is not None:
        rows, values = np.array(turn.angles).T
        if turn.interpolation == "linear" or len(rows) == 1:
            angle = float(np.interp(time, rows, values))
        else:
            angle = float(CubicSpline(rows, values, bc_type="clamped")(np.clip(time, rows[0], rows[-1])))
    back = Rotation.from_rotvec(-angle * np.array(turn.axis) / np.linalg.norm(turn.axis))
    return back.apply(x - centre[row]) + centre[0]  # about the wall's own centre, whose way is in the history


def _members(case: Case, name: str | None) -> np.ndarray:
    """Mesh numbers of the nodes of a node set, or of all."""
    table = {} if name is None else case.node_set[name].as_table()
    return members_of(generated(case.to_dict()["mesh"]), table)


def _distances(wall: WallKeys, x: np.ndarray) -> np.ndarray:
    """Distance (m,) of points from the surface, negative beyond it; zero for a surface beside which nodes can pass."""
    arm = x - np.array(wall.point)
    if wall.type == "surface":
        surface = pv.read(wall.file).triangulate()
        if surface.n_open_edges or wall.side == "both":
            return np.zeros(len(x))
        distances = pv.PolyData(arm / wall.scale).compute_implicit_distance(surface)["implicit_distance"]
        return wall.scale * np.asarray(distances) * (-1.0 if wall.flip else 1.0)
    if wall.type in ("plane", "rectangle"):
        return arm @ np.array(wall.normal) / np.linalg.norm(wall.normal)
    if wall.type == "cylinder":
        axis = np.array(wall.axis) / np.linalg.norm(wall.axis)
        arm = arm - np.multiply.outer(arm @ axis, axis)
    length = np.linalg.norm(arm, axis=1)
    return length - wall.radius if wall.side == "outside" else wall.radius - length


def _before_rectangle(
    wall: WallKeys,
    result: Loaded,
    i: int,
    members: np.ndarray,
    at: np.ndarray,
    rows: dict[int, int],
) -> np.ndarray:
    """Nodes that were before the rectangle in the last snapshot and well inside of its edges then and now."""
    if i == 0 or result.steps[i] - result.steps[i - 1] > 1:
        return np.zeros(len(at), dtype=bool)
    row = rows.get(int(result.steps[i - 1]))
    if row is None and f"wall/{wall.name}/position" in result.history:
        return np.zeros(len(at), dtype=bool)
    before = _seen(wall, result.positions[i - 1][members], result.history, row)
    normal = np.array(wall.normal) / np.linalg.norm(wall.normal)
    along = np.array(wall.along) - (np.array(wall.along) @ normal) * normal
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    inside = _distances(wall, before) >= 0.0
    for x in (before, at):
        arm = x - np.array(wall.point)
        inside &= (np.abs(arm @ along) < 0.45 * wall.size[0]) & (np.abs(arm @ across) < 0.45 * wall.size[1])
    return inside


def _wilson(case: Case, history: dict[str, np.ndarray], result: Loaded) -> float:
    if case.time.integrator != "wilson":
        return 0.0
    if "velocity" not in result.fields:
        return np.inf
    fastest = float(np.abs(result.fields["velocity"]).max())
    walls = [np.abs(c).max() for n, c in history.items() if n.startswith("wall/") and n.endswith("/velocity")]
    return 2.0 * (case.time.scheme.theta - 1.0) * float(history["step_size"].max()) * (fastest + sum(walls))


def _energy(case: Case, history: dict[str, np.ndarray], warned: list[str], size: float) -> Faults:
    scale = energy_scale(history)
    # below: a truss at rest, whose energies are squares of rounding errors
    if not scale > 1e-24 * _strongest(case) * size:
        return []
    faults = _open(history)
    heat = history["plastic_heat"]
    if (np.diff(heat) < -1e-9 * scale).any() or heat.min() < -1e-9 * scale:
        faults.append(("plastic heat falls", f"{np.diff(heat).min() / scale:.3g} of the largest energy"))
    kinds = ("damping", "friction", "impact", "damage", "rupture", "self_contact")
    for name in (f"{kind}_dissipation" for kind in kinds):
        if name in history and history[name].min() < -1e-9 * scale:
            faults.append((f"{name} negative", f"{history[name].min() / scale:.3g} of the largest energy"))
    return faults + _gains(case, history, warned, scale)


def _strongest(case: Case) -> float:
    """E A of the stiffest bar [N]."""
    return max(m.young_modulus for m in case.material.values()) * max(
        _areas(case, s).max() for s in case.section.values()
    )


def _areas(case: Case, section: Section) -> np.ndarray:
    """Area of the bars of a section [m2], one or one of each bar of the mesh."""
    if section.area_field is not None:
        return np.array(case.to_dict()["mesh"]["bar_fields"][section.area_field])
    return np.array([section.uniform_area])


def _sections(case: Case) -> Faults:
    """Check that areas are those of closed forms."""
    faults: Faults = []
    for name, section in case.section.items():
        if section.shape is None or section.area is not None or section.area_field is not None:
            continue
        expected = closed_area(section.shape, section.sizes)
        if not abs(section.uniform_area - expected) <= 1e-12 * expected:
            faults.append(("area is not that of the sizes", f"{name}: {section.uniform_area} and {expected} m2"))
    return faults


def _mass(case: Case, history: dict[str, np.ndarray]) -> Faults:
    """Check the momentum of a body that begins in translation: areas, densities, unstressed lengths, nodal masses."""
    start = case.initial[0] if len(case.initial) == 1 else None
    adjusted = any(wall.adjust for wall in case.wall)  # which changes lengths in the mesh
    if start is None or start.node_set is not None or any(start.angular_velocity) or case.support or adjusted:
        return []
    table = case.to_dict()["mesh"]
    slab, fields = generated(table), table.get("bar_fields", {})
    ends = slab.points[np.asarray(slab.bars)]
    lengths, lines = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), np.zeros(len(slab.bars))
    for section in sorted(case.section.values(), key=lambda section: section.bars is not None):
        rows = slice(None) if section.bars is None else slab.bar_groups[str(section.bars)]
        rest = section.rest_length if isinstance(section.rest_length, float) else 1.0
        rest = np.array(fields.get(section.rest_length_field, np.full(len(lines), rest)))
        made = np.broadcast_to(_areas(case, section), lines.shape) * rest * case.material[section.material].density
        lines[rows] = made[rows]
    nodal = sum(mass.value * len(_members(case, mass.node_set)) for mass in case.point_mass)
    expected = (lines @ lengths + nodal) * np.array(start.velocity)
    if not np.abs(history["momentum"][0] - expected).max() <= 1e-9 * np.abs(expected).max():
        return [("momentum at the start is not that of the mass", f"{history['momentum'][0]} and {expected}")]
    return []


def _members_table(folder: Path, result: Loaded) -> Faults:
    """Check the table of members against the axial forces of the snapshots."""
    forces = result.fields.get("axial_force")
    if forces is None or not len(result.steps):
        return []
    opened = open_result(folder)
    whole, times = members(opened, per="bar"), np.asarray(opened.times)
    bars = whole["bars"].astype(int)
    shown = forces[np.abs(times[:, None] - whole["time"]).argmin(axis=0), bars]
    scale = np.abs(forces).max()
    if not np.abs(shown - whole["axial_force"]).max(initial=0.0) <= 1e-12 * scale:
        return [("members: axial_force is not that of the snapshot", f"{np.abs(shown - whole['axial_force']).max()}")]
    each = members(opened, per="bar", each_case=True) if result.case.stage else None
    for column, extreme in (("tension", np.maximum), ("compression", np.minimum)):
        expected = np.zeros(len(result.fields["axial_force"][0]))
        if each is None:
            expected = extreme(expected, extreme.reduce(forces))
        else:
            extreme.at(expected, each["bars"].astype(int), each[column])
        if not np.abs(whole[column] - expected[bars]).max(initial=0.0) <= 1e-12 * scale:
            return [(f"members: {column} is not the extreme of the rows", f"{whole[column]}, {expected[bars]}")]
    return []


def stage_end(opened: Result, name: str) -> int:
    """Number of the snapshot at the end of a stage, a load case or a combination."""
    k = [stage.name for stage in opened.case.stages].index(name)
    return int(np.abs(np.asarray(opened.times) - np.asarray(opened.stage_ends)[k + 1]).argmin())


def _states(folder: Path, result: Loaded) -> Faults:
    """Check that a form stays where it is, and that a combination of one load case with the factor 1 is this case."""
    opened, names = open_result(folder), [stage.name for stage in result.case.stages]
    pairs = [("form", "built")] if "built" in names else []
    pairs += [(next(iter(row.factors)), row.name) for row in result.case.combination if row.name == "same"]
    faults: Faults = []
    for one, other in pairs:
        a, b = (result.positions[stage_end(opened, name)] for name in (one, other))
        if not np.abs(a - b).max() <= 1e-9 * result.size:
            faults.append((f"{other} is not {one.rstrip('0123456789')}", f"{np.abs(a - b).max() / result.size:.3g}"))
    return faults


def _gains(case: Case, history: dict[str, np.ndarray], warned: list[str], scale: float) -> Faults:
    """What contact and the scheme give, beyond what was put in, and is still there in the last quarter of the run.

    A peak that passes is none: velocities of held nodes are those of the scheme's formulas, and overshoot.
    """
    if any("energy" in text or "amplifies" in text for text in warned):
        return []
    faults: Faults = []
    moving = any(wall.velocity or wall.motion or wall.mass or wall.rotation for wall in case.wall)
    put_in = history["kinetic_energy"][0] + history["elastic_energy"][0]
    put_in += np.abs(history["external_work"]).max() + np.abs(history["thermal_work"]).max()
    put_in += history["spring_energy"][0]
    put_in += np.abs(history["prestress_work"]).max()
    reference = scale if moving else min(scale, float(put_in))
    lost = sum(history[name] for name in LOSSES if name in history)
    work = history["contact_work"] - (lost - history["numerical_dissipation"])
    last = slice(-max(len(work) // 4, 1), None)
    if not moving:
        treatment = case.contact.treatment
        most = work.max() if treatment == "stick" else work[last].mean()
        if most > (1e-3 if treatment == "stick" else 0.05) * reference:
            faults.append(("contact work positive", f"{treatment}: {most / reference:.3g} of the energy put in"))
    gain = (-lost if moving else history["contact_work"] - lost)[last]
    stays = float(gain.mean())
    plan = make_plan(Model(case, MPI.COMM_SELF)) if stays > 0.05 * reference else None
    if plan is not None and plan.scheme.explicit:
        held = history["elastic_energy"][last] + history["spring_energy"][last]
        swing = (0.5 * history["step_size"][last] * plan.frequency.upper) ** 2 * held
        stays = min(stays, float((gain - swing).max()))
    if stays > 0.05 * reference:
        cause = "energy grows without a warning"
        faults.append((cause, f"by {stays / reference:.3g} of {'the largest energy' if moving else 'what was put in'}"))
    return faults


def _momentum(case: Case, history: dict[str, np.ndarray]) -> Faults:
    """Check that momentum is the initial momentum plus all recorded impulses, if the history has them."""
    if "external_impulse" not in history:
        return []
    parts = {"external": history["external_impulse"], "supports": history["support_impulse"]}
    parts["damping"] = history["damping_impulse"]
    for wall in case.every_wall:
        for what in ("impulse", "jump_impulse"):
            if f"wall/{wall.name}/{what}" in history:
                parts[f"{wall.name} {what}"] = history[f"wall/{wall.name}/{what}"]
    change = history["momentum"] - history["momentum"][0]
    open_part = np.abs(change - sum(part - part[0] for part in parts.values())).max()
    mass = _speed_scale(history)
    scale = max(mass, *(float(np.abs(part).max()) for part in parts.values()))
    # forces of rounding, over all steps: the impulses of walls that touch a truss at rest add up
    rounding = 1e-12 * _strongest(case) * float(history["time"][-1])
    tolerance = max(1e-9, 4.0 * case.solver.rtol)  # what a solver leaves of a balance is a force without an impulse
    if scale > rounding and open_part > tolerance * scale + rounding:
        return [("momentum is not that of the impulses", f"{open_part / scale:.3g} of the largest")]
    return []


def _speed_scale(history: dict[str, np.ndarray]) -> float:
    """Largest momentum of the truss [kg m/s]."""
    return float(np.linalg.norm(history["momentum"], axis=1).max())


def distance(one: Path, other: Path) -> tuple[float, str]:
    """Return the largest relative difference of two results, and where it is.

    Positions are relative to the size of the truss, energies to the largest energy, momenta to the largest momentum (or
    that of the displacement of the centre, if they cancel), forces of walls to the largest force.
    """
    a, b = Loaded(one), Loaded(other)
    worst = paths_distance(a, b)
    history = a.history
    energy = max(energy_scale(history), 1e-300)
    speed = np.abs(history["momentum"]).max()
    size = max(a.size, 1e-300)
    scales = {"momentum": speed, "angular_momentum": speed * size, "centre_of_mass": size}
    for name in history:
        if name.endswith(("_iterations", "releases", "changes", "contact_time", "active_contacts", "contacts")):
            continue
        x, y = (np.asarray(run.history[name], dtype=float) for run in (a, b))
        if x.shape != y.shape:
            return np.inf, f"{name}: {x.shape} and {y.shape}"
        if name.endswith(("_energy", "_work", "_dissipation", "_heat", "_imbalance")):
            scale = energy
        elif name in scales:
            scale = max(scales[name], 1e-300)
        elif name in ("time", "step", "step_size") or name.endswith("/position"):
            scale = max(np.abs(x).max(), size)
        else:
            continue
        apart = float(np.abs(x - y).max()) / scale
        if apart > worst[0]:
            worst = apart, name
    return worst


def paths_distance(a: Loaded, b: Loaded) -> tuple[float, str]:
    """Largest distance of a node in one result from itself in the other, over the truss's size."""
    if a.positions.shape != b.positions.shape:
        return np.inf, f"{len(a.steps)} and {len(b.steps)} snapshots"
    if not a.positions.size:
        return 0.0, "nothing"
    apart = np.abs(a.positions - b.positions).max(axis=(1, 2)) / max(a.size, 1e-300)
    i = int(apart.argmax())
    return float(apart[i]), f"positions in snapshot {i} of {len(a.steps)}"
