"""Checks before a run: values out of any engineering range, gaps to walls, odd nodes and bars; its summary, and
estimates of its memory, time and disk space.

Odd values are mostly due to units other than SI. They are reported, never rejected, and so are mechanisms, which are
no error in dynamics: chains and cables consist of them.
"""

from __future__ import annotations

import math
import resource
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from .case.model import INTEGRATORS
from .case.tables import Modes
from .contact.bars_at_walls import small_walls
from .contact.neighbours import Points, Segments, find_pairs
from .errors import PfemError
from .files import memory_of_machine
from .mesh.exchange import Router
from .mesh.slab import slab_of
from .mesh.tools import components
from .output.units import duration, engineering
from .registry import lookup
from .solvers.matrix_free import add_blocks, full_blocks
from .tolerances import ON_BOUND

if TYPE_CHECKING:
    from .case.schema import Case
    from .columns import Fields
    from .mesh.distribution import DistributedMesh
    from .stepping.model import Model
    from .stepping.plan import Plan

_SLENDER = 1e4
"""Length over thickness of a bar beyond which one of the two is mostly in another unit: a cable of 100 m and 1 cm."""

_LEAST = 5e-6
"""Strain at which no material yields or breaks: 220 for 220 MPa is 1e-9, in kPa 1e-6; soft metals yield at 1e-4."""

_PRESTRAINS = 1e-6, 0.2
"""Range of strains that prestress gives engineering structures: cables have 1e-4 to 1e-2, those hardly taut 1e-5."""

_LARGEST_AREA = 10.0
"""Area of bars [m2] beyond which another unit is likely."""

_STRENGTHS = ("yield_stress", "proof_stress", "tensile_strength")

_INSTANTS = 201
"""Of a run at which the motion of the ground is looked at."""

_OPENING = math.sqrt(2.0)
"""Widest body that passes between the nodes of a square mesh of bars, over the length of these."""

_HINT = "case files are in SI units (m, kg, s, N, Pa)"


def warnings_before(case: Case, model: Model, plan: Plan, first: bool = True) -> list[str]:
    """Return warnings of the cheap checks, which run at every start. Collective.

    ``first``: False for a later stage: positions and velocities at its start are not known before the run, and what
    depends on the mesh alone is reported with the first stage.
    """
    geometry, source = Geometry(model), f"{case.source}: " if first else ""
    texts = [f"{source}{text}" for text in odd_numbers(case, model)]
    texts += memory_warning(model, plan, source) + idle_walls(model) + narrow_walls(model)
    texts += wall_gaps(model)[1] if first else []
    texts += _braked_ground(case, model, plan)
    if first:
        count, nodes, lowest = geometry.parts()
        if count > 1 and not model.links:  # links connect bodies
            texts.append(
                f"the truss is in {count} parts that no bar connects; the smallest has {nodes} nodes, node {lowest} "
                "among them"
            )
    return texts + _loose_nodes(case, model, geometry)


def _braked_ground(case: Case, model: Model, plan: Plan) -> list[str]:
    """Return a warning if the ground moves as a whole and damping acts on its velocity noticeably. Collective."""
    supports, inertia = model.supports, model.inertia
    if case.time is None or not supports.moves or supports.inclined is not None or not inertia.damped:
        return []
    times = np.linspace(0.0, plan.end, _INSTANTS)
    v, a = (np.array(each).reshape(_INSTANTS, -1) for each in zip(*(supports.rates(t, plan.step) for t in times)))
    most = np.full((3, _INSTANTS, 3), -np.inf)  # largest v, -v and |a| of each component over all supports
    for axis in range(3):
        of_axis = supports.components == axis
        for out, values in zip(most, (v, -v, np.abs(a)), strict=True):
            out[:, axis] = values[:, of_axis].max(axis=1, initial=-np.inf)
    share = np.divide(inertia.damping, inertia.mass, out=np.zeros_like(inertia.mass), where=inertia.mass > 0.0)
    rate = model.comm.allreduce(float(share.max(initial=0.0)), op=MPI.MAX)
    model.comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
    together = np.abs(most[0] + most[1])[np.isfinite(most[0])].max(initial=0.0) == 0.0
    speed, pull = np.abs(most[0][np.isfinite(most[0])]).max(initial=0.0), most[2].max(initial=0.0)
    if not together or rate * speed <= 0.5 * pull:
        return []
    return [
        f"damping acts on absolute velocities, and the ground moves with up to {speed:.3g} m/s: it loads masses by up "
        f"to {rate * speed:.3g} m/s2, beside accelerations of the ground up to {pull:.3g} m/s2; damping relative to "
        "the ground needs stiffness_damping alone"
    ]


def inspect(case: Case, model: Model) -> tuple[dict[str, str], list[str]]:
    """Return label and text of further entries of ``check``, and warnings. Collective."""
    geometry, warnings = Geometry(model), []
    count, _, _ = geometry.parts()
    entries = {"parts": "all bars are connected" if count == 1 else f"{count} that no bar connects"}
    rigidity = geometry.rigidity()
    entries |= {"rigidity": rigidity} if rigidity else {}
    notes = {name: getattr(wall, "note", "") for name, wall in zip(model.contact.names, model.contact.walls)}
    entries |= {f"wall {name}": text + notes[name] for name, text in wall_gaps(model)[0].items()}
    period, advice = _period(model)
    entries, warnings = entries | period, warnings + advice
    if not _is_own(case):
        return entries, warnings
    found = geometry.nodes_on_bars()
    if found is None:
        entries["nodes on bars"] = "not checked: bars of too different lengths"
        return entries, warnings
    between, on_bars, coinciding, together = found
    if coinciding:
        pairs = _list(coinciding // 2, together)
        entries["same place"] = f"{coinciding:,} nodes, {pairs}: merge them unless they are on different bodies"
    if between:
        many = "nodes lie on bars that they are not connected to"
        what = many if between > 1 else "node lies on a bar that it is not connected to"
        shown = _list(between, on_bars)
        warnings.append(f"{between} {what}: {shown}; if they are intended to be connected, divide the bar there")
    return entries, warnings


_MODES_UP_TO = 3000
"""Components up to which the lowest natural frequency of the initial state is computed by ``check``."""
_STEPS = (40, 100)
"""Steps of a period that are advised: for damped motion, and for resonance with little damping."""


def _period(model: Model) -> tuple[dict[str, str], list[str]]:
    """Return the lowest natural frequency and the steps in its period as an entry, and what is advised. Collective.

    Of implicit steps alone: explicit ones are far smaller. Without an entry for large models, and where there is no
    such frequency: mechanisms, initial velocities, contact that modes do not support.
    """
    case = model.case
    times = [stage.time for stage in case.editor[0].stages if stage.time is not None]
    implicit = [t for t in times if not lookup(INTEGRATORS, t.integrator, "time.integrator").Scheme.explicit]
    if not implicit or 3 * model.mesh.n_nodes > _MODES_UP_TO:
        return {}, []
    step = max(time.step for time in implicit)
    from .modes.find import InitialState, find_modes

    try:
        stepper = InitialState(model)
        stepper.start()
        found = find_modes(model, stepper.state, Modes(count=1), case.mass == "consistent")
    except PfemError:
        return {}, []
    frequency = float(found.values[0]) if len(found.values) else 0.0
    if not frequency > 0.0:
        return {}, []
    steps = 1.0 / (frequency * step)
    entry = f"{engineering(frequency, 'Hz')} in the initial state, {steps:.3g} steps a period"
    few, many = _STEPS
    if steps >= few:
        return {"lowest frequency": entry}, []
    fine = engineering(1.0 / (many * frequency), "s")
    return {"lowest frequency": entry}, [
        f"time.step = {engineering(step, 's')}: {steps:.3g} steps in the period of the lowest frequency, "
        f"{engineering(frequency, 'Hz')}: take {few} for damped motion and {many}, {fine}, for resonance with little "
        f"damping, whose amplitude is some 5 % too small at {few}"
    ]


def _is_own(case: Case) -> bool:
    """Whether nodes and bars come from the user: from a file, arrays, or from a unit cell of a lattice.

    Other generated meshes are valid by construction, and their members are not divided.
    """
    return not case.mesh.arranged or getattr(case.mesh.parameters, "cell", None) is not None


def _loose_nodes(case: Case, model: Model, geometry: Geometry) -> list[str]:
    """Warn of nodes that can move freely, as those within a member that was divided. Collective.

    Static analyses that need a stiffness name such nodes and their directions themselves, if it is singular.
    """
    static = case.static is not None and case.static.method != "relaxation"
    if static:
        from .statics.stability import names_motions

        if names_motions(model):
            return []
    loose, first = geometry.unbraced()
    divided = (
        ". Was the mesh subdivided? Each member of a truss is one bar: in Gmsh `Transfinite Curve {:} = 2;` (an "
        "intended chain of bars, such as a cable, needs tension to be stiff)"
    )
    text = (
        f"{loose} node{'s' if loose > 1 else ''} can move freely, to first order: bars and supports hold too few "
        f"directions there; the first is node {first}{divided if _is_own(case) else ''}"
    )
    return [text] if loose else []


def _list(count: int, shown: list[str]) -> str:
    return ", ".join(shown) + (", ..." if count > len(shown) else "")


def odd_numbers(case: Case, model: Model) -> Iterator[str]:
    """Yield one message for each suspicious value: key, value, reason. Collective."""
    yield from _materials(case)
    yield from _sections(case)
    yield from _areas(case, model)
    yield from _mesh(model)
    yield from _slender(case, model)
    for wall in case.wall:
        if wall.gravity and case.gravity is None:
            yield f"wall {wall.name!r}: gravity = true, but the case has no [gravity], so none acts on it"
    for name, node_set in case.node_set.items():
        if node_set.nearest is not None:
            away = np.linalg.norm(model.mesh.points[: model.mesh.n_owned] - np.array(node_set.nearest), axis=1)
            distance, node = _extreme(model, -away)
            if -distance > model.length:
                yield (
                    f"node_set.{name}.nearest: the nearest node is node {node}, {engineering(-distance, 'm')} away "
                    "from the point, more than the size of the truss"
                )


def _materials(case: Case) -> Iterator[str]:
    for name, material in case.material.items():
        key = f"material.{name}"
        speed = math.sqrt(material.young_modulus / material.density)
        if not 0.1 <= material.density <= 3e4:
            yield f"{key}.density = {material.density:g} kg/m3: no solid has that; {_HINT}"
        if not 0.5 <= speed <= 2e4 or (speed < 10.0 and material.density > 100.0):
            yield (
                f"{key}.young_modulus = {material.young_modulus:g} Pa gives a wave speed of "
                f"{engineering(speed, 'm/s')}: that of steel is 5 km/s, of rubber 30 m/s; {_HINT}"
            )
        yield from material.suspicions(key, _HINT)
        strengths = {f"{key}.{name}": getattr(material, name, None) for name in _STRENGTHS}
        for name in ("stress", "compressive_stress"):
            strengths[f"{key}.rupture.{name}"] = getattr(material.rupture, name, None)
        for name, stress in strengths.items():
            if stress is not None and stress < _LEAST * material.young_modulus:
                strain = stress / material.young_modulus
                yield f"{name} = {stress:g} Pa is reached at a strain of {strain:.3g}; 220 MPa are 220e6; {_HINT}"


def _sections(case: Case) -> Iterator[str]:
    for name, section in case.section.items():
        area = section.uniform_area
        if area is not None and not 1e-18 <= area <= _LARGEST_AREA:
            yield f"section.{name}: area = {area:g} m2: no bar has that; 1 mm2 is 1e-6 m2"
        young = case.material[section.material].young_modulus
        stiffness = None if area is None else young * area
        for key, unit, hard in (("prestress", "Pa", young), ("pretension", "N", stiffness)):
            given = getattr(section, key)
            if given is None or hard is None:
                continue
            value = float(np.abs(np.atleast_2d(np.array(given, dtype=float))[:, -1]).max())
            if value and not _PRESTRAINS[0] <= value / hard <= _PRESTRAINS[1]:
                yield f"section.{name}.{key} reaches {value:g} {unit}, a strain of {value / hard:.3g}; {_HINT}"


def _areas(case: Case, model: Model) -> Iterator[str]:
    """Areas from fields of the mesh, which may be in square millimetres."""
    largest = np.zeros(len(case.section))
    for block, bars in zip(model.mesh.blocks, model.bars.blocks, strict=True):
        if not isinstance(bars.area, float) and block.section < len(largest):  # others are springs and dashpots
            largest[block.section] = max(largest[block.section], float(bars.area.max(initial=0.0)))
    model.comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    for (name, section), area in zip(case.section.items(), largest.tolist(), strict=True):
        if area > _LARGEST_AREA:
            key = f"section.{name}.area_field = {section.area_field!r}"
            yield f"{key} has areas up to {area:g} m2: no bar has that; 1 mm2 is 1e-6 m2"


def _slender(case: Case, model: Model) -> Iterator[str]:
    """Bars far longer than thick: a mesh in millimetres with areas in square metres."""
    mesh = model.mesh
    worst = np.zeros((len(case.section), 3))  # length over thickness, length, area
    for block, bars in zip(mesh.blocks, model.bars.blocks, strict=True):
        lengths = model.bars.mesh_lengths[block.start : block.counted]
        if len(lengths) and block.section < len(worst):  # others are springs and dashpots
            area = np.broadcast_to(bars.counted_area, lengths.shape)
            ratios = lengths / np.sqrt(area)
            most = np.flatnonzero(ratios == ratios.max())
            longest = most[lengths[most].argmax()]
            worst[block.section] = ratios[longest], lengths[longest], area[longest]
    for name, *rows in zip(case.section, *model.comm.allgather(worst.tolist()), strict=True):
        ratio, length, area = max(rows)
        if ratio > _SLENDER and area >= 1e-18:  # smaller areas are reported as such
            yield (
                f"section.{name}: a bar of {engineering(length, 'm')} is {ratio:,.0f} times as long as it "
                f"is thick (area = {area:g} m2): is the mesh in millimetres? {_HINT}"
            )


def _extreme(model: Model, values: np.ndarray) -> tuple[float, int]:
    """Return the largest of the values (owned,) of nodes, and the lowest mesh number of a node with it. Collective."""
    at = int(values.argmax()) if len(values) else -1
    mine = (-float(values[at]), int(model.mesh.node_ids[at])) if at >= 0 else (np.inf, -1)
    least, node = min(model.comm.allgather(mine))
    return -least, node


def _mesh(model: Model) -> Iterator[str]:
    if model.reach > 1e6 * max(model.length, np.finfo(float).tiny):
        yield (
            f"the truss is {engineering(model.length, 'm')} in size and {engineering(model.reach, 'm')} away from the "
            "origin: strains lose accuracy by this ratio; move it to the origin"
        )
    with np.errstate(over="ignore"):  # reported below
        fastest, node = _extreme(model, np.linalg.norm(model.initial_velocity(), axis=1))
    if fastest > model.wave_speed:
        yield (
            f"node {node} starts at {engineering(fastest, 'm/s')}, faster than waves in the bars "
            f"({engineering(model.wave_speed, 'm/s')}): an impact at that speed crushes bars to zero length"
        )


def idle_walls(model: Model) -> list[str]:
    """Warn of walls that apply to no node. Collective."""
    members = model.comm.allreduce(model.contact.members.sum(axis=0))
    return [
        f"wall {name!r} applies to no node: name a node_set that has nodes, or omit node_set"
        for name, count in zip(model.contact.names, members[model.contact.first], strict=True)
        if not count
    ]


def narrow_walls(model: Model) -> list[str]:
    """Warn of walls that can pass between the nodes of the bars there. Collective."""
    contact, mesh, texts = model.contact, model.mesh, []
    real = mesh.bar_ids < mesh.n_bars - mesh.n_connectors
    for k in small_walls(contact.walls):
        members = np.zeros(mesh.n_local, dtype=bool)
        members[: mesh.n_owned] = contact.members[:, contact.first[k]]
        near = real & members[mesh.bars].any(axis=1)
        touch, other = model.self_contact, ""
        if touch is not None and contact.walls[k].solid:  # which these bars touch between their nodes
            near &= ~touch.chosen
        elif touch is not None:
            other = ", or triangles with a thickness instead, which bars that touch do not pass"
        longest = model.comm.allreduce(float(model.bars.mesh_lengths[near].max(initial=0.0)), op=MPI.MAX)
        width = contact.walls[k].width
        if width < _OPENING * longest:
            texts.append(
                f"wall {contact.names[k]!r} is {engineering(width, 'm')} wide, and the bars of its nodes are up to "
                f"{engineering(longest, 'm')} long: only nodes touch walls, so that it can pass between them; use a "
                f"wall wider than {_OPENING:.2f} times the bars that it meets, or shorter bars{other}"
            )
    return texts


def _nearest(model: Model, gaps: np.ndarray) -> Iterator[tuple[float, int]]:
    """Yield for each wall the least of the gaps (owned, walls) [m], and the lowest node that has it. Collective."""
    for each in gaps.T:
        least, node = _extreme(model, -each)
        yield -least, node


def later_gaps(model: Model) -> dict[str, str]:
    """Return, by wall of a later stage, the gap of the nearest node in the mesh, before stages move it. Collective."""
    told, stage = {}, model.case.name
    gaps = model.contact.gaps(model.mesh.points[: model.mesh.n_owned], 0.0)
    for name, (gap, node) in zip(model.contact.names, _nearest(model, gaps), strict=True):
        text = f"gap {engineering(gap, 'm')} at node {node} in the mesh, before earlier stages move it"
        if gap < -ON_BOUND * model.size:
            text = (
                f"node {node} is {engineering(-gap, 'm')} beyond it in the mesh: the stage cannot begin unless earlier "
                "stages move such nodes to the allowed side"
            )
        told[f"wall {name}, stage {stage}"] = text if np.isfinite(gap) else "applies to no node"
    return told


def wall_gaps(model: Model) -> tuple[dict[str, str], list[str]]:
    """Return, by wall name, nearest node, gap and how fast it closes at the start; and warnings. Collective."""
    contact, mesh, comm = model.contact, model.mesh, model.comm
    told: dict[str, str] = {}
    warnings: list[str] = []
    if not contact.any:
        return told, warnings
    points, v = mesh.points[: mesh.n_owned], model.initial_velocity()
    # the rate of the gap over a short displacement, a thousandth of the model's size
    fastest = comm.allreduce(float(np.abs(v).max(initial=0.0)), op=MPI.MAX)
    ahead = 1e-6 * model.length / fastest if fastest > 0.0 else 1e-9
    now, then = contact.gaps(points, 0.0), contact.gaps(points + ahead * v, ahead)
    bodies = contact.motion.bodies  # not moving yet: displacements of nodes relative to these walls
    rates = contact.motion.rates_at(points, 0.0) if bodies.any else np.empty((len(points), len(contact.names), 3))
    for k in bodies.at:
        seen = contact.gap(k, points + ahead * (v - rates[:, k]), contact.motion.poses(0.0))
        then[:, k] = np.where(contact.members[:, contact.first[k]], seen, np.inf)
    with np.errstate(invalid="ignore"):
        rate = np.nanmin((then - now) / ahead, axis=0, initial=np.inf)
    comm.Allreduce(MPI.IN_PLACE, rate, op=MPI.MIN)
    # a moving wall, or the other node of a link, may push the truss against this wall
    static = model.case.static is not None
    pushed = model.external.active or contact.moving.any() or bool(model.links) or model.supports.any
    for k, (name, (gap, node)) in enumerate(zip(contact.names, _nearest(model, now), strict=True)):
        if not np.isfinite(gap):
            told[name] = "applies to no node"
            continue
        told[name] = f"gap {engineering(gap, 'm')} at node {node}"
        if rate[k] < 0.0:
            told[name] += f", closing at up to {engineering(-float(rate[k]), 'm' if static else 'm/s')}"
            told[name] += " per unit of the load factor" if static else ""
        elif not pushed:
            told[name] += ", not approached"
            warnings.append(
                f"no node moves towards wall {name!r}, and no force drives one there: check the direction of its "
                "normal and of the initial velocity"
            )
    return told, warnings


_NEAR = 1e-6
"""A node whose distance from a bar is less than this fraction of its length lies on it. Coordinates saved in single
precision have this accuracy."""

_SHOWN = 5
_RANK = 1e-9

_LARGEST = 600
"""Maximum number of unknowns for the global test, a singular value decomposition of a dense matrix."""


class Geometry:
    """The nodes and bars of a model, and what is odd about them. All methods are collective."""

    def __init__(self, model: Model) -> None:
        self._model, self._mesh, self._comm = model, model.mesh, model.comm

    @cached_property
    def _held(self) -> np.ndarray:
        """(owned, 3, 3) Sums of d d^T over the directions d of the bars of each node."""
        mesh, stored = self._mesh, np.zeros((2, len(self._mesh.bars)))
        stored[0] = self._model.bars.mesh_lengths**-2.0
        blocks = np.zeros((mesh.n_local, 6))
        add_blocks(mesh.bars, mesh.points, stored, blocks)
        return full_blocks(blocks[: mesh.n_owned])

    @cached_property
    def span(self) -> np.ndarray:
        """Orthonormal directions (r, 3) that the bars span: r = 1 for a rod, 2 for a plane truss."""
        values, vectors = np.linalg.eigh(self._comm.allreduce(self._held.sum(axis=0)))
        return vectors[:, values > 1e-12 * values[-1]].T

    def _lowest(self, nodes: np.ndarray) -> tuple[int, int]:
        """Return how many nodes are marked (owned,) on all ranks, and the lowest of their mesh numbers."""
        ids = self._mesh.node_ids[: self._mesh.n_owned][nodes]
        lowest = self._comm.allreduce(int(ids.min(initial=self._mesh.n_nodes)), op=MPI.MIN)
        return self._comm.allreduce(len(ids)), lowest

    def parts(self) -> tuple[int, int, int]:
        """Return the number of connected parts, and the size and lowest node number of the smallest one.

        Every node gets the lowest mesh number that it is connected to: within a rank at once, between ranks by the
        exchange of ghosts, repeated until no rank changes anything.
        """
        mesh, comm, owned = self._mesh, self._comm, self._mesh.n_owned
        label = mesh.node_ids[: mesh.n_local].astype(np.float64).reshape(-1, 1)  # whole numbers, exact to 2^53
        part, changed = components(mesh.n_local, mesh.bars), True
        while changed:
            before = label[:owned].copy()
            np.minimum.at(label, part, label.copy())
            label = label[part]
            mesh.update_ghosts(label)
            # a ghost may have a lower number, and this rank's own numbers may still have to propagate
            changed = comm.allreduce(not np.array_equal(before, label[:owned]), op=MPI.LOR)
        names, sizes = np.unique(label[:owned, 0].astype(np.int64), return_counts=True)
        # a rank adds up the parts whose lowest node is in its range of the mesh numbers, however many there are
        router = Router(comm, slab_of(names, mesh.n_nodes, comm.size))
        own, places = np.unique(router.send(names), return_inverse=True)
        total = np.bincount(places.ravel(), weights=router.send(sizes), minlength=len(own)).astype(np.int64)
        smallest = min(zip(total.tolist(), own.tolist()), default=(mesh.n_nodes + 1, -1))
        return comm.allreduce(len(own)), *min(comm.allgather(smallest))

    def nodes_on_bars(self) -> tuple[int, list[str], int, list[str]] | None:
        """Return the number of nodes on bars between their ends, and of coinciding nodes, each with the lowest few as
        texts; None if the search would take too long, as lengths of bars differ too much."""
        mesh, comm = self._mesh, self._comm
        bars = np.arange(len(mesh.bars))[mesh.counted]
        bars = bars[mesh.bar_ids[bars] < mesh.n_bars - mesh.n_connectors]
        own = np.arange(mesh.n_owned, dtype=np.int32)
        segments = Segments(
            np.concatenate([mesh.bar_ids[bars], mesh.node_ids[own]]),
            np.concatenate([mesh.bars[bars], np.stack([own, own], axis=1)]),
            np.concatenate([_NEAR * self._model.bars.mesh_lengths[bars], np.zeros(len(own))]),
            np.repeat(np.array([1, 2], np.uint8), [len(bars), len(own)]),
        )
        pairs = find_pairs(comm, Points(mesh.points, mesh.node_ids), segments)
        if pairs is None:
            return None
        part = pairs.at[:, 0]
        inner = (part > _NEAR) & (part < 1.0 - _NEAR)
        between = int(inner.sum())
        rows = np.concatenate([pairs.ids, pairs.names[:, 0]], axis=1)[inner]
        on_bars = sorted(rows.tolist())[:_SHOWN]
        end = pairs.names[np.arange(len(part)), 0, (part > 0.5).astype(np.int64)]
        # one for each bar of its nodes
        twins = np.unique(np.sort(np.stack([end, pairs.ids[:, 1]], axis=1)[~inner], axis=1), axis=0)
        alike = np.unique(twins)
        alike = np.unique(Router(comm, slab_of(alike, mesh.n_nodes, comm.size)).send(alike))
        every = sorted(row for some in comm.allgather(on_bars) for row in some)[:_SHOWN]
        shown = [f"node {node} on {_bar(bar, a, b)}" for bar, node, a, b in every]
        together = sorted({tuple(pair) for some in comm.allgather(twins[:_SHOWN].tolist()) for pair in some})
        twins_shown = [f"nodes {a} and {b}" for a, b in together[:_SHOWN]]
        return comm.allreduce(between), shown, comm.allreduce(len(alike)), twins_shown

    def unbraced(self) -> tuple[int, int]:
        """Return the number of nodes that can move freely, to first order, and the lowest of them.

        Only directions within the line or plane of the whole truss count: a plane truss is never braced out of its
        plane.
        """
        span, inside = self.span, self._held
        if self._model.supports.any:
            inside = inside + self._model.supports.spans()
        if len(span) < 3:  # else it would only be turned
            inside = np.einsum("ri,nij,sj->nrs", span, inside, span)
        # det / trace^(r-1) is a lower bound of the smallest eigenvalue: well above zero, no more work is needed
        trace = np.trace(inside, axis1=1, axis2=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            doubtful = ~(np.linalg.det(inside) / trace ** (len(span) - 1) > _RANK)
        if doubtful.any():
            doubtful[doubtful] = np.linalg.eigvalsh(inside[doubtful])[:, 0] < _RANK
        return self._lowest(doubtful)

    def rigidity(self) -> str:
        """Return the counts of mechanisms and states of self-stress as text; empty for large models.

        The equilibrium matrix A (free unknowns, bars) maps bar forces to nodal forces. With rank r there are b - r
        states of self-stress and n - r free motions (Maxwell, Calladine); rigid-body motions of the truss are not
        mechanisms.
        """
        mesh, comm, span = self._mesh, self._comm, self.span
        n, owned = mesh.n_nodes, mesh.n_owned
        if 3 * n > _LARGEST:
            return ""
        numbered = np.column_stack([mesh.bar_ids, mesh.node_ids[mesh.bars]]).tolist()
        bars = np.array(sorted({tuple(bar) for some in comm.allgather(numbered) for bar in some}))[:, 1:]
        points, held = np.zeros((n, 3)), np.zeros((n, 3, 3))
        points[mesh.node_ids[:owned]] = mesh.points[:owned]
        held[mesh.node_ids[:owned]] = self._model.supports.spans()
        points, held = comm.allreduce(points), comm.allreduce(held)
        direction = points[bars[:, 1]] - points[bars[:, 0]]
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        matrix, columns = np.zeros((n, 3, len(bars))), np.arange(len(bars))
        matrix[bars[:, 0], :, columns], matrix[bars[:, 1], :, columns] = -direction, direction
        # unknowns: directions within the span that are not prescribed
        reduced = np.concatenate([_free(span, some) @ rows for some, rows in zip(held, matrix, strict=True)])
        rank = int(np.linalg.matrix_rank(reduced, tol=_RANK)) if reduced.size else 0
        rigid = _rigid_motions(points - points.mean(axis=0), held, span)
        outside = sum(len(_free(np.eye(3), some)) for some in held) - len(reduced)
        where = {1: " along its line", 2: " in its plane", 3: ""}[len(span)]
        label = components(n, bars)
        parts = [np.flatnonzero(label == name) for name in np.unique(label)]
        every = sum(_rigid_motions(points[part] - points[part].mean(axis=0), held[part], span) for part in parts)
        # parts that no bar connects move against each other, and turn about axes of their own
        apart = f", {every - rigid} of parts against each other" if every > rigid else ""
        text = (
            f"{len(reduced)} free directions{where}, {rigid} rigid motions{apart}, {len(reduced) - rank - every} "
            f"mechanisms, {len(bars) - rank} states of self-stress"
        )
        return text + (f"; {outside} free directions out of it, which no bar resists" if outside else "")


def _bar(number: int, a: int, b: int) -> str:
    return f"bar {number} (nodes {a} and {b})"


def _free(span: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return orthonormal directions within the span that supports with the projection ``held`` leave free."""
    _, values, vectors = np.linalg.svd(held @ span.T, full_matrices=True)
    return vectors[int((values > 1e-12).sum()) :] @ span


def _rigid_motions(arms: np.ndarray, held: np.ndarray, span: np.ndarray) -> int:
    """Return the number of unsupported rigid-body motions within the span."""
    axes, arms = np.eye(3), arms / max(float(np.abs(arms).max()), np.finfo(float).tiny)
    turns = np.cross(axes, arms[:, None]).swapaxes(1, 2)
    motions = np.concatenate([np.broadcast_to(axes, turns.shape), turns], axis=2)
    stopped = np.concatenate([(axes - span.T @ span) @ motions, held @ motions]).reshape(-1, 6)
    _, values, vectors = np.linalg.svd(stopped, full_matrices=True)
    allowed = vectors[int((values > 1e-9).sum()) :].T
    return int(np.linalg.matrix_rank(motions.reshape(-1, 6) @ allowed, tol=1e-9)) if allowed.size else 0


# Resident memory of a rank per bar, in excess of an empty process [B]; measured with lattices: 54 explicit, 74 if bars
# yield on a floor, 170 matrix-free (between 10^6 and 4 x 10^6 bars), 510 assembled, 1580 with GAMG (10^5 to 5 x 10^5);
# factorised by MUMPS 4,200 at 2.7 x 10^4 and 8,200 at 1.7 x 10^5 bars.
_PER_BAR = {
    "": 80.0,
    "jacobi": 200.0,
    "multigrid": 350.0,
    "pbjacobi": 550.0,
    "icc": 800.0,
    "ilu": 800.0,
    "gamg": 1700.0,
}
_PER_BAR_FACTORISED, _FACTORISED_AT = 4200.0, 2.7e4
_EMPTY = 2.2e8  # of a process with all libraries loaded [B]
# Seconds per bar and step or iteration on one core, and additional seconds per step.
_SECONDS_EXPLICIT = 1.5e-8
_SECONDS_PER_ITERATION = 4e-8
_SECONDS_PER_STEP = 2.5e-4

_THICK = 0.3
"""Relative density above which struts are no lattice of slender bars (Gibson and Ashby, Cellular Solids, 1997)."""


def forecast(
    case: Case,
    model: Model,
    plan: Plan,
    fields: Fields,
    columns: Mapping[str, np.dtype],
) -> dict[str, str]:
    """Return label and text of the estimates of memory and, if the steps are known, of time and disk. Collective."""
    plans = plan.stages or (plan,)
    held = model.comm.allreduce(max(_needed(model, each) for each in plans))
    entries = {"memory needed": f"about {engineering(held, 'B', 3)} by the end of the run, on all ranks"}
    known = [(stage, each) for stage, each in zip(case.stages, plans, strict=True) if each.steps is not None]
    if known:
        seconds = sum(_seconds(model, each) for _, each in known)
        size = result_bytes(known, model.mesh, fields.points, fields.cells, columns)
        counted = [stage for stage, _ in known]
        unknown = [f"stage {stage.name!r}" for stage in case.stages if stage not in counted]
        if seconds:  # modes alone have no steps
            entries["run time"] = (
                f"about {duration(seconds)} of steps on idle cores, within a factor of 3; start, "
                "compilation and output are extra"
            )
        most = "at most " if case.output.compression != "none" else "about "
        entries["result file"] = f"{most}{engineering(size, 'B', 3)}"
        if unknown:
            entries["not included"] = f"run time and results of {', '.join(unknown)}: the number of steps is not known"
    if case.output.checkpoint_every or case.output.checkpoint_minutes:
        entries["checkpoints"] = f"two of about {engineering(checkpoint_bytes(model), 'B', 3)}"
    return entries


def result_bytes(
    stages: Sequence[tuple[Case, Plan]],
    mesh: DistributedMesh,
    point_fields: Collection[str],
    cell_fields: Collection[str],
    columns: Mapping[str, np.dtype],
) -> float:
    """Return the size of the result file [B]: snapshots, history rows, and the structure of the file."""
    item = 4 if stages[0][0].output.precision == "float32" else 8
    snapshots = rows = 1
    for case, plan in stages:
        every = case.output.fields_every
        snapshots += 1 + ((plan.steps - 1) // every if every else 0)
        rows += 1 + (plan.steps - 1) // case.output.history_every
    a_snapshot = mesh.n_nodes * (24 + 3 * item * len(point_fields)) + mesh.n_bars * item * len(cell_fields)
    a_row = sum(dtype.itemsize for dtype in columns.values())
    # a chunk of the history is allocated as a whole
    chunks = -(-rows // 512) * 512
    return 1e5 + 33.0 * mesh.n_bars + snapshots * (a_snapshot + 80.0) + chunks * a_row


def checkpoint_bytes(model: Model) -> float:
    """Return the size of a checkpoint [B]."""
    return 1e4 + model.mesh.n_nodes * 24.0 * 8 + 8.0 * len(model.bars.kept_names) * model.mesh.n_bars


def memory_warning(model: Model, plan: Plan, source: str) -> list[str]:
    """Return a warning if the ranks on a machine need more memory than it has. Collective."""
    comm = model.comm
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    needed, available, ranks = machine.allreduce(_needed(model, plan)), memory_of_machine(), machine.size
    machine.Free()
    mine = (needed / available, needed, available, ranks, MPI.Get_processor_name())
    ratio, needed, available, ranks, name = max(comm.allgather(mine))
    if ratio <= 1.0:
        return []
    return [
        f"{source}the {ranks} ranks on {name} will need about {engineering(needed, 'B', 3)} of memory, and it "
        f"has {engineering(available, 'B', 3)}: the system may end the run; use more machines, a smaller mesh, or an "
        "explicit scheme"
    ]


def _needed(model: Model, plan: Plan) -> float:
    """Return the maximum memory of this rank until the end of the run [B]."""
    kind = "" if plan.linear is None else plan.linear.preconditioner
    each = _PER_BAR.get(kind, max(_PER_BAR.values()))
    if plan.linear is not None and plan.linear.factorises or model.case.modes is not None:
        # fill-in in three dimensions: the factors of n unknowns have O(n^(4/3)) entries
        each = _PER_BAR_FACTORISED * (model.mesh.n_bars / _FACTORISED_AT) ** (1.0 / 3.0)
    return max(_used(), _EMPTY + each * len(model.mesh.bars))


def _used() -> float:
    """Return the maximum memory of this rank so far [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0  # kibibytes on Linux


def _seconds(model: Model, plan: Plan) -> float:
    """Return the time of all steps on the slowest rank [s], an order of magnitude only for implicit schemes."""
    bars = model.comm.allreduce(len(model.mesh.bars), op=MPI.MAX)
    if plan.linear is None:
        return plan.steps * (_SECONDS_PER_STEP + _SECONDS_EXPLICIT * bars)
    iterations = 100.0 if plan.linear.factorises else 50.0
    return plan.steps * (10.0 * _SECONDS_PER_STEP + _SECONDS_PER_ITERATION * iterations * bars)


def summarise(case: Case, model: Model, plan: Plan) -> dict[str, str]:
    """Return label and text of sizes, distribution, time step and solver. Collective."""
    mesh, comm = model.mesh, model.comm
    owned, ghosts = np.array(comm.allgather((mesh.n_owned, mesh.n_local - mesh.n_owned))).T
    ranks = f"{comm.size}"
    if comm.size > 1:
        most = f"{owned.max():,} nodes"
        own = f"{most} each" if owned.min() == owned.max() else f"{owned.min():,} to {most}"
        ranks += f", owning {own} ({mesh.partitioner}), at most {ghosts.max():,} ghosts"
    walls = [
        wall.name if wall.mass is None else f"{wall.name} ({engineering(wall.mass, 'kg')})" for wall in case.every_wall
    ]
    modes = {}
    if model.case.modes is not None:
        from .modes.find import describe_modes

        modes = describe_modes(model)
    return {
        "nodes": f"{mesh.n_nodes:,}",
        "bars": f"{mesh.n_bars:,}",
        "ranks": ranks,
        "extent": " x ".join(engineering(float(d), "m") for d in model.high - model.low),
        **_density(model),
        "mass": engineering(model.total_mass, "kg") + f" ({case.mass})",
        "wave speed": engineering(model.wave_speed, "m/s"),
        **plan.texts,
        **modes,
        "walls": ", ".join(walls) or "none",
        **({} if model.self_contact is None else {"bars that touch": model.self_contact.text()}),
        **({"contact pairs": ", ".join(pair.name for pair in case.contact_pair)} if case.contact_pair else {}),
        **({"constraints": ", ".join(f"{c.name} ({c.kind})" for c in case.constraint)} if case.constraint else {}),
        "memory": f"{engineering(comm.allreduce(_used()), 'B', 3)} used so far, on all ranks",
    }


def _density(model: Model) -> dict[str, str]:
    """Return the relative density of a lattice, the volume of its bars over that of what it fills, and how much of a
    surface its cells fill. Collective."""
    mesh = model.mesh
    if mesh.volume is None:
        return {}
    lengths = model.bars.mesh_lengths
    own = [float((each.counted_area * lengths[each.start : each.counted]).sum()) for each in model.bars.blocks]
    ratio = model.comm.allreduce(sum(own)) / mesh.volume
    thick = "; struts so thick overlap at nodes, where this counts them more than once" if ratio > _THICK else ""
    texts = {"relative density": f"{ratio:.4g} (volume of bars over {engineering(mesh.volume, 'm3')}){thick}"}
    if mesh.filled is not None:
        inside = engineering(mesh.volume, "m3")
        texts["filled"] = f"{engineering(mesh.filled, 'm3')} by the cells of its struts, of {inside} inside the surface"
    return texts
