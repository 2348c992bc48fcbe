"""The motion of a result for pictures: its frames, where nodes, walls and probes are in each, what is marked, and what
acts, as the symbols of engineering drawings: triangles for supports, arrows for loads.

A wall module may define ``surface(parameters, bounds)``, which returns what is drawn of a wall.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from ..columns import STATUS
from ..contact.rotations import turns_about
from ..contact.walls.base import WALLS, Surface, perpendicular, slab
from ..errors import InputError
from ..mechanics.bars import bar_shapes
from ..mechanics.motion import rotation_of
from ..mechanics.supports import directions_of
from ..output.result import check_mesh, stage_at
from ..output.units import MODE, POINT, engineering
from ..registry import choices, lookup, nearest
from .page import GHOST, MARKS, TRAILS
from .scene import NODE_COLOUR, Camera, Layer, Scene

MOST_FRAMES = 300
"""Snapshots that are drawn without an option: more make a film of over ten seconds."""

_MOST = 20_000  # frames in slow motion
STOUT = 0.2
"""Largest radius of a drawn bar as a fraction of its length; nodes of stouter ones would hide their bars."""

_LARGEST = 0.1  # of the extent of the truss: the largest displacement that is drawn
PERIOD = 24  # frames of a period

_STUB = 0.35  # of the initial length: the part of a broken bar that is drawn at each of its nodes
_MOST_NODES = 5000  # of which the outermost are found; of more, the corners of their box are in view
_WAYS = 200  # directions in which nodes are outermost: a sphere is larger than their hull by 1 %


class Motion:
    """What the frames of one result have in common.

    Parameters
    ----------
    result : an open result
    frames : numbers of its snapshots
    options : ``scale`` of displacements, and what is drawn in addition to the bars: ``ghost``, ``marks``, ``trails``,
        see :class:`~pfem_petsc.post.options.Options`
    note : receives messages

    Attributes
    ----------
    bounds : (2, 3) [m], corners of the motion
    hulls : for each frame (n, 3) [m]: outermost nodes, or the corners of a large structure
    boxes : (frames, 2, 3) [m], corners of the structure in each frame
    reach : [m], how far the picture of a node extends around it
    times : (frames,) [s]

    Raises
    ------
    InputError
        For marks and probes that the result does not have, and a scale that is not finite.
    """

    def __init__(self, result: Any, frames: Sequence[int], options: Any, note: Callable[[str], None]) -> None:
        if not np.isfinite(options.scale):
            raise InputError(f"render: scale = {options.scale:g}, the factor on displacements, must be finite")
        self.result, self.frames, self._options, self.note = result, list(frames), options, note
        self.scale = options.scale
        self.bars = np.asarray(result.bars)
        self.start = np.asarray(result.positions(0), dtype=float)
        self.times = np.asarray(result.times, dtype=float)[self.frames]
        self.n_bars = len(self.bars)
        for mark in options.marks:
            if MARKS[mark].field not in result.cell_fields:
                raise InputError(
                    f"render: mark = {mark!r}: the result holds no field '{MARKS[mark].field}'; "
                    "name it in [output] fields and run again, or leave the mark out"
                )
        self._trails = {name: self._probe_rows(name) for name in options.trails}
        self.reach, self.hulls = 0.0, [_outermost(self._held(frame)) for frame in self.frames]
        self.boxes = np.array([[points.min(axis=0), points.max(axis=0)] for points in self.hulls])
        self._ghost = [_outermost(self.start)] if options.ghost else []
        seen = np.concatenate([*self.hulls, *self._ghost])
        self.bounds = np.array([seen.min(axis=0), seen.max(axis=0)])
        self.actions = Actions(result, options.show, self.times, self.bounds) if options.show else None
        if self.actions is not None:
            for k, frame in enumerate(self.frames):
                ends = self.actions.arrows(k, self.positions(frame)).reshape(-1, 3)
                self.hulls[k] = np.concatenate([self.hulls[k], ends])
            self.reach = self.actions.size
        walls = result.case.every_wall
        self.surfaces = self._moved(walls)
        self.normals = [wall.normal / np.linalg.norm(wall.normal) for wall in walls if hasattr(wall, "normal")]
        every = np.asarray(result.times, dtype=float)
        self.time_factor, self.time_unit = result.axis.scale(float(np.abs(every).max()))
        steps = np.diff(np.unique(self.time_factor * every))
        self._decimals = int(np.clip(np.ceil(0.3 - np.log10(np.median(steps))), 0, 6)) if len(steps) else 2

    def _moved(self, walls: Sequence[Any]) -> dict[int, list[Surface]]:
        """Return, by frame, the surfaces of the walls at that time; a wall at rest has the same one in all frames.

        Those that a stage does not have are left out.
        """
        times = self.result.times[self.frames]
        shifts, turns, present = walls_at(self.result, times)
        still = {surface.name: surface for surface in wall_surfaces(walls, self.bounds, self.note)}
        surfaces: dict[int, list[Surface]] = {frame: [] for frame in self.frames}
        for row, k in np.argwhere(present).tolist():
            surface, shift, turn = still.get(walls[k].name), shifts[row, k], turns[row, k]
            turned = bool((turn != np.eye(3)).any())
            if walls[k].type == "plane" and not turned:  # which is drawn beside the structure, wherever it is
                normal = np.asarray(walls[k].normal) / np.linalg.norm(walls[k].normal)
                shift = (shift @ normal) * normal
            if surface is not None and (turned or shift.any()):
                centre = _place(walls[k])
                surface = replace(surface, points=(surface.points - centre) @ turn.T + centre + shift)
            surfaces[self.frames[row]] += [] if surface is None else [surface]
        return surfaces

    @property
    def surroundings(self) -> np.ndarray:
        """Points (n, 3) [m] that the camera has in view: the motion, and walls near it."""
        near = [*self.hulls, *self._ghost]
        size = float(np.linalg.norm(self.bounds[1] - self.bounds[0])) or 1.0
        for points in {id(wall): wall.points for walls in self.surfaces.values() for wall in walls}.values():
            # a distant wall would shrink the structure to a dot: it is drawn but does not affect the view
            gap = np.maximum(points.min(axis=0) - self.bounds[1], self.bounds[0] - points.max(axis=0))
            near += [points] if gap.max() < 0.6 * size else []
        return np.concatenate(near)

    @property
    def upward(self) -> np.ndarray:
        """Upward direction (3,) of pictures: against gravity along y, else z."""
        gravity = getattr(self.result.case, "gravity", None)
        pull = np.zeros(3) if gravity is None else np.asarray(gravity.mean, dtype=float)
        if pull[1] and np.count_nonzero(pull) == 1:
            return np.array([0.0, -float(np.sign(pull[1])), 0.0])
        return np.array([0.0, 0.0, 1.0])

    @property
    def notes(self) -> list[str]:
        """What is not true to scale, and what acts: for the foot of the picture."""
        untrue = getattr(self.result, "untrue", None)
        notes = [untrue(self.scale)] if untrue is not None else []
        notes += [f"displacements × {self.scale:g}"] if untrue is None and self.scale != 1.0 else []
        return notes + (self.actions.notes if self.actions is not None else [])

    def positions(self, frame: int) -> np.ndarray:
        """Positions (nodes, 3) [m] as drawn."""
        points = np.asarray(self.result.positions(frame), dtype=float)
        return points if self.scale == 1.0 else self.start + self.scale * (points - self.start)

    def whole(self, frame: int) -> np.ndarray:
        """Return which bars (b,) have not left the model; all if the result does not tell."""
        if "status" not in self.result.cell_fields:
            return np.full(self.n_bars, True)
        return np.asarray(self.result.field("status", frame)) != STATUS.index("broken")

    def _held(self, frame: int) -> np.ndarray:
        """Return the positions of nodes with bars: others may fly far away, and would shrink the picture."""
        points, whole = self.positions(frame), self.whole(frame)
        return points[np.unique(self.bars[whole])] if whole.any() else points

    def time(self, frame: int) -> str:
        """The heading of a frame."""
        if hasattr(self.result, "caption"):
            return self.result.caption(frame)
        axis, time = self.result.axis, self.result.times[frame]
        if axis.staged:
            return self.result.place(time)
        if axis is POINT and "load_factor" in (history := self.result.history):
            return f"{axis.place(time)}, load factor {np.interp(time, history['time'], history['load_factor']):.4g}"
        if not axis.unit:
            return axis.place(time)
        return f"{axis.symbol} = {time * self.time_factor:.{self._decimals}f} {self.time_unit}"

    def probe(self, name: str) -> np.ndarray:
        """Mean positions (frames, 3) [m] of the nodes of a probe as drawn."""
        when, places = self._probe_rows(name)
        middle = places.mean(axis=1)
        return np.stack([np.interp(self.times, when, middle[:, axis]) for axis in range(3)], axis=1)

    def _probe_rows(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        history, column = self.result.history, f"probe/{name}/position"
        known = [key.split("/")[1] for key in history if key.startswith("probe/") and key.endswith("/position")]
        if column not in history:
            way = f"its probes are {', '.join(known)}{nearest(name, known)}" if known else "give an [[output.probe]]"
            raise InputError(f"render: the result has no probe '{name}'; {way}")
        when, places = np.asarray(history["time"], dtype=float), np.asarray(history[column], dtype=float)
        return when, places if self.scale == 1.0 else places[0] + self.scale * (places - places[0])

    def layers(self, frame: int, scene: Scene, camera: Camera) -> list[Layer]:
        """Return what is drawn in addition to the bars of a frame."""
        made, points, thick = [], self.positions(frame), scene.thickness(camera)
        width, whole = scene.width / scene.unit, self.whole(frame)
        if self._options.ghost:
            made.append(Layer(self.start, self.bars, GHOST, float(np.clip(0.6 * width, 1.2, 2.4)), -thick))
        if "yielded" in self._options.marks:
            yielded = np.asarray(self.result.field("plastic_strain", frame)) != 0.0
            made.append(scene.rim(points, np.flatnonzero(yielded & whole), MARKS["yielded"].colour))
        if "broken" in self._options.marks:
            made.append(self._stubs(points, ~whole, width))
        if self.actions is not None:
            made += self.actions.layers(self.frames.index(frame), points, camera)
        for number, (when, places) in enumerate(self._trails.values()):
            past = max(1, int(np.searchsorted(when, self.result.times[frame], side="right")))
            rows = np.stack([np.arange(past - 1), np.arange(1, past)], axis=1)
            colour = TRAILS[number % len(TRAILS)]
            made += [Layer(places[:, node], rows, colour, 2.4, thick) for node in range(places.shape[1])]
        return made

    def _stubs(self, points: np.ndarray, gone: np.ndarray, width: float) -> Layer:
        """Return both ends of each broken bar, which point at each other."""
        one, two = points[self.bars[gone, 0]], points[self.bars[gone, 1]]
        now, initial = np.linalg.norm(two - one, axis=1), _lengths(self.result)[gone]
        part = (_STUB * np.minimum(1.0, initial / np.maximum(now, 1e-300)))[:, None] * (two - one)
        lines = np.arange(4 * len(one)).reshape(2, -1).T
        return Layer(np.concatenate([one, two, one + part, two - part]), lines, MARKS["broken"].colour, max(2.0, width))


MOST_SYMBOLS = 40
"""Nodes that all have symbols."""
_SOME = 24  # of more, which are evenly spread
_SYMBOL, _ARROW, _HEAD = 0.03, 0.14, 0.022  # of the diagonal of the truss: supports, the longest arrow, its head
# symbols of supports, in units of their size: lines between points, away from the node and across
_TRIANGLE = np.array([[(0.0, 0.0), (1.0, 0.55)], [(1.0, 0.55), (1.0, -0.55)], [(1.0, -0.55), (0.0, 0.0)]])
_STROKES = np.array([[(1.0, at), (1.3, at - 0.165)] for at in (0.55, 0.275, 0.0, -0.275)])  # below where nothing moves
_TRACK = np.array([[(1.3, 0.55), (1.3, -0.55)]])  # along which the node may move
_FRONT = 700.0  # pixels of a page of 1280 by 720: symbols are before the truss
_SMALL = 0.02  # of the largest load of a stage: smaller ones have no arrow
_ALONG = 0.999  # cosine from which a direction is that of the view


class Actions:
    """Supports and loads of a result, whose model is made again.

    Parameters
    ----------
    result : an open result
    kinds : ``supports``, ``loads``
    times : of the frames, on the axis of the result
    bounds : (2, 3) [m], corners of the truss, for the size of symbols

    Attributes
    ----------
    notes : what is told of them below the picture
    size : [m], how far symbols of supports extend

    Raises
    ------
    InputError
        If the mesh is not there any more, or has other bars.
    """

    def __init__(self, result: Any, kinds: Sequence[str], times: np.ndarray, bounds: np.ndarray) -> None:
        from mpi4py import MPI

        from ..stepping.model import Model

        self._stages, self._start, history = result.case.stages, np.asarray(result.positions(0)), result.history
        model = Model(self._stages[0], MPI.COMM_SELF, later=self._stages[1:])
        check_mesh(result, model.mesh)
        self._models = [model, *(Model(stage, MPI.COMM_SELF, model.mesh) for stage in self._stages[1:])]
        self._ids, self._centre, self.notes = model.mesh.node_ids[: model.mesh.n_owned], bounds.mean(axis=0), []
        self._diagonal, self._kinds = float(np.linalg.norm(bounds[1] - bounds[0])), kinds
        self.size = 1.5 * _SYMBOL * self._diagonal if "supports" in kinds else 0.0
        when = np.asarray(history["time"], dtype=float)
        rows = np.asarray(history["stage"]) if "stage" in history else np.zeros(len(when), dtype=int)
        self._history = when, rows, np.asarray(history.get("load_factor", when), dtype=float)
        for number in np.unique(rows)[1:].tolist():  # each stage takes over what acts at the end of another one
            first = self._stages[number].starts_from
            before = number - 1 if first is None else first
            external = self._models[before].external
            end = self._own(before, float(when[rows == before][-1]))
            held = external.loads_at(end), external.gravity_at(end), external.wind_at(end)
            self._models[number].external.hold(*held, True)
        numbers = stage_at(history, times).tolist()
        self._moments = [(k, self._own(k, float(time))) for k, time in zip(numbers, times, strict=True)]
        self._supports: list[list[tuple[np.ndarray, np.ndarray, float]]] = []  # nodes, directions, until when
        removed: list[dict[str | None, float]] = []
        for number, (stage, own) in enumerate(zip(self._stages, self._models, strict=True)):
            before = removed[number - 1 if stage.starts_from is None else stage.starts_from] if number else {}
            ends = dict.fromkeys(before, -np.inf) | {entry.supports: entry.time for entry in stage.remove}
            removed.append(ends)
            sets = [(self._ids[own.nodes[each.node_set]], each) for each in stage.support]
            self._supports.append([(n, directions_of(each)[0], ends.get(each.name or "", np.inf)) for n, each in sets])
        held_nodes = np.unique(
            np.concatenate([self._ids[:0], *(nodes for each in self._supports for nodes, *_ in each)])
        )
        self._shown = self._thinned(held_nodes, "supported") if "supports" in kinds else self._ids[:0]
        size = np.zeros((len(self._stages), len(self._ids)))
        for number in range(len(times)) if "loads" in kinds else ():
            own = size[self._moments[number][0]]
            np.maximum(own, np.linalg.norm(self._loads(number), axis=1), out=own)
        self._largest, self._loaded = size.max(axis=1, initial=0.0), self._ids[:0]
        if self._largest.any():
            large = size > _SMALL * self._largest[:, None]
            self._loaded = self._thinned(np.flatnonzero(large.any(axis=0)), "loaded")

    def _own(self, number: int, time: float) -> float:
        """Return the load factor of a static stage, or the time since the start of another, at a time of the run."""
        when, rows, factors = self._history
        begin, own = float(when[rows < number].max(initial=0.0)), rows == number
        if self._stages[number].static is None:
            return time - begin
        start = ([begin], [0.0]) if number else ([], [])  # of which the history has no row
        return float(np.interp(time, [*start[0], *when[own]], [*start[1], *factors[own]]))

    def _loads(self, number: int) -> np.ndarray:
        """Return the loads (nodes, 3) [N] of a frame."""
        (stage, own), loads = self._moments[number], np.zeros((len(self._ids), 3))
        loads[self._ids] = self._models[stage].external.loads_at(own)
        return loads

    def _thinned(self, nodes: np.ndarray, what: str) -> np.ndarray:
        """Return nodes for symbols, of many those nearest to the middles of as many clusters as there may be."""
        if len(nodes) <= MOST_SYMBOLS:
            return nodes
        middles, _ = kmeans2(self._start[nodes], _SOME, minit="++", seed=0)
        some = nodes[np.unique(cKDTree(self._start[nodes]).query(middles)[1])]
        self.notes.append(f"symbols at {len(some):,} of {len(nodes):,} {what} nodes")
        return some

    def longest(self, number: int) -> str:
        """Say which load the longest arrow is, in all frames of the same stage or load case; nothing without loads."""
        largest = float(self._largest[self._moments[number][0]])
        return f"longest arrow {engineering(largest, 'N', 3)}" if largest else ""

    def everywhere(self, number: int) -> dict[str, np.ndarray]:
        """Gravity and wind (3,) of a frame, if there are any, by their names."""
        if "loads" not in self._kinds:
            return {}
        stage, own = self._moments[number]
        external = self._models[stage].external
        ways = {"g": external.gravity_at(own), "wind": external.wind_at(own)}
        return {name: way / np.linalg.norm(way) for name, way in ways.items() if way.any()}

    def arrows(self, number: int, points: np.ndarray) -> np.ndarray:
        """Return tails and tips (2, n, 3) [m] of the loads of a frame, whose tips are at points (nodes, 3) [m]."""
        largest = self._largest[self._moments[number][0]]
        if not largest:
            return np.zeros((2, 0, 3))
        force = self._loads(number)[self._loaded] / largest
        kept = np.linalg.norm(force, axis=1) > _SMALL
        force, at = force[kept], points[self._loaded[kept]]
        return np.stack([at - _ARROW * self._diagonal * force, at])

    def layers(self, number: int, points: np.ndarray, camera: Camera) -> list[Layer]:
        """Return the symbols of a frame at points (nodes, 3) [m]."""
        tails, tips = self.arrows(number, points)
        way = tips - tails
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way = way / np.maximum(length, 1e-300)
        across = np.cross(way, camera.towards)
        head = np.minimum(_HEAD * self._diagonal, 0.5 * length)
        ends = [tips - head * way + side * 0.4 * head * across for side in (1.0, -1.0)]
        pairs = [np.stack(pair, axis=1) for pair in [(tails, tips), *((tips, end) for end in ends)]]
        return [_lines(pairs, 2.2), _lines(self._triangles(number, points, camera), 1.5)]

    def _triangles(self, number: int, points: np.ndarray, camera: Camera) -> list[np.ndarray]:
        """Return the lines (n, 2, 3) of supports: one triangle with strokes below where all seen directions are
        held; else one for each direction, with a second line, along which the node may move."""
        held: dict[int, list[np.ndarray]] = {}
        stage, now = self._moments[number]
        for nodes, directions, end in self._supports[stage]:
            if now > end * (1.0 + 1e-9):
                continue
            seen = [d for d in directions if not (camera.parallel and abs(d @ camera.towards) > _ALONG)]
            for node in np.intersect1d(nodes, self._shown).tolist():
                held.setdefault(node, []).extend(seen)
        lines: list[np.ndarray] = []
        size, every = _SYMBOL * self._diagonal, 2 if camera.parallel else 3
        upward = np.eye(3)[np.argmax(np.abs(camera.up))] * np.sign(camera.up[np.argmax(np.abs(camera.up))])
        for node, ways in held.items():
            at, fixed = points[node], len(ways) >= every
            for way in [upward] if fixed else ways:
                side = way @ upward if abs(way @ upward) > 0.5 else (self._centre - at) @ way
                away = -way if side >= 0.0 else way
                across = np.cross(away, camera.towards)
                axes = np.stack([away, across / max(float(np.linalg.norm(across)), 1e-300)])
                lines += [at + size * symbol @ axes for symbol in (_TRIANGLE, _STROKES if fixed else _TRACK)]
        return lines


def _lines(pairs: Sequence[np.ndarray], width: float) -> Layer:
    """Return a layer of lines, as pairs of points (n, 2, 3) [m]."""
    points = np.concatenate([np.zeros((0, 2, 3)), *pairs]).reshape(-1, 3)
    return Layer(points, np.arange(len(points)).reshape(-1, 2), NODE_COLOUR, width, _FRONT)


def _outermost(points: np.ndarray) -> np.ndarray:
    """Return the points of (n, 3) that are farthest in evenly spread directions, or the corners of the box of many."""
    if len(points) > _MOST_NODES:
        return np.array(np.meshgrid(*np.array([points.min(axis=0), points.max(axis=0)]).T)).reshape(3, -1).T
    ways = np.concatenate([np.random.default_rng(0).normal(size=(_WAYS, 3)), np.eye(3), -np.eye(3)])
    return points[np.unique(np.argmax(points @ ways.T, axis=0))]


def chosen_frames(
    frames: int | Iterable[int] | None,
    times: np.ndarray,
    note: Callable[[str], None],
    span: Sequence[float] | None = None,
) -> list[int]:
    """Return the numbers of the snapshots to draw.

    Raises
    ------
    InputError
        For numbers that the result does not have.
    """
    if len(times) == 0:
        raise InputError("render: the result holds no snapshots; set [output] fields_every and run again")
    within = np.arange(len(times))
    if span is not None:
        first, last = _checked(span, times)
        within = within[(times >= first) & (times <= last)]
        if not len(within):
            raise InputError(f"render: span = {first:g} {last:g} holds no snapshot; give a longer one, or rate")
    if isinstance(frames, Iterable):
        chosen = [int(k) for k in frames]
        for k in chosen:
            if not -len(times) <= k < len(times):
                raise InputError(f"render: frame {k} does not exist; the result holds snapshots 0 to {len(times) - 1}")
        if not chosen:
            raise InputError("render: frames is an empty list")
        return [k % len(times) for k in chosen]
    count = len(within)
    if frames is None and count > MOST_FRAMES:
        note(f"{MOST_FRAMES} of {count} snapshots are drawn; ask for more with frames = {count}")
    wanted = MOST_FRAMES if frames is None else frames
    if wanted < 1:
        raise InputError(f"render: frames = {frames} must be positive; a list of numbers may count from the end")
    if wanted == 1:
        return within[-1:].tolist()  # at the first one, most structures are at rest and look like their mesh
    return within[even_rows(count, wanted)].tolist()


def even_rows(rows: int, count: int) -> list[int]:
    """Return at most a count of rows at even distances, among them the first and the last."""
    return np.linspace(0, rows - 1, min(count, rows)).round().astype(int).tolist()


def even_times(times: np.ndarray, rate: float, span: Sequence[float] | None) -> np.ndarray:
    """Return times at a rate [1/s] from the first snapshot to the last, or within a span.

    Raises
    ------
    InputError
        For a rate that makes no film.
    """
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError(f"render: rate = {rate:g} frames per simulated second must be positive")
    first, last = (times[0], times[-1]) if span is None else _checked(span, times)
    count = (last - first) * rate + 1.0
    if not 2.0 <= count <= _MOST:
        raise InputError(
            f"render: rate = {rate:g} makes {count:.6g} frames of {first:g} to {last:g}; give 2 to {_MOST} frames"
        )
    return first + np.arange(int(count + 1e-9)) / rate


def _checked(span: Sequence[float], times: np.ndarray) -> tuple[float, float]:
    first, last = span
    if not (np.isfinite(first) and first < last and last >= times[0] and first <= times[-1]):
        raise InputError(
            f"render: span = {first:g} {last:g} must be two increasing times between {times[0]:g} and {times[-1]:g}"
        )
    return max(first, float(times[0])), min(last, float(times[-1]))


class Frames:
    """A result with other snapshots, or parts, in pictures.

    Parameters
    ----------
    result : an open result
    parts : what is another one, by the names that results have; and what only pictures ask for: ``caption(i)``, the
        heading of frame i, ``instants(count)``, the frames of a page, ``untrue(scale)``, what displacements are
    """

    def __init__(self, result: Any, **parts: Any) -> None:
        self._result = result
        self.__dict__.update(parts)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._result, name)


def resampled(result: Any, times: np.ndarray) -> Frames:
    """Return a result at other times (n,) [s]: positions and fields are linear between snapshots, constant outside.

    The status of bars is that of the snapshot before.
    """
    own = np.asarray(result.times, dtype=float)
    places = np.interp(times, own, np.arange(len(own)))

    def mixed(values: Callable[[int], np.ndarray], i: int) -> np.ndarray:
        k, part = int(places[i]), places[i] % 1.0
        before = np.asarray(values(k), dtype=float)
        return before + part * (values(k + 1) - before) if part >= 1e-9 else before

    def field(name: str, i: int) -> np.ndarray:
        return result.field(name, int(places[i])) if name == "status" else mixed(lambda k: result.field(name, k), i)

    return Frames(result, times=np.asarray(times), positions=lambda i: mixed(result.positions, i), field=field)


def mode_frames(result: Any, modes: Sequence[int] | None = None, period: int = PERIOD) -> Frames:
    """Return modes as the snapshots of a result that :func:`~pfem_petsc.post.render.render` draws, a period each.

    The field ``amplitude`` is the length of a node's displacement relative to the largest.

    Parameters
    ----------
    result : an open result
    modes : numbers of the modes from 1; None: all
    period : frames of a period

    Raises
    ------
    InputError
        Where the result has no modes, or not these.
    """
    if period < 4:
        raise InputError(f"render: {period} frames a period are too few for modes; give 4 or more")
    found = result.modes
    numbers = list(range(1, len(found) + 1)) if modes is None else list(modes)
    for number in numbers:
        if not 1 <= number <= len(found):
            raise InputError(f"render: mode {number} does not exist; the result holds modes 1 to {len(found)}")
    labels, place = [found.label(number - 1) for number in numbers], result.positions(-1)
    shapes = found.shape[np.array(numbers, dtype=int) - 1]
    sizes = np.linalg.norm(shapes, axis=2)
    amplitudes = sizes / sizes.max(axis=1)[:, None]
    extent = float(np.linalg.norm(np.ptp(place, axis=0))) or 1.0
    shapes = shapes * (_LARGEST * extent / sizes.max(axis=1))[:, None, None]
    phases = np.sin(2.0 * np.pi * np.arange(period) / period)
    return Frames(
        result,
        point_fields=("amplitude",),
        cell_fields=(),
        axis=MODE,
        times=np.full(period * len(numbers), result.times[-1]),  # walls are where they are at the end
        positions=lambda i: place + phases[i % period] * shapes[i // period],
        field=lambda name, i: amplitudes[i // period] if name == "amplitude" else result.field(name, -1),
        untrue=lambda scale: f"largest displacement drawn as {scale * _LARGEST:g} of the extent",
        caption=lambda i: labels[i // period],
        instants=lambda count: [period * mode + period // 4 for mode in range(min(count, len(numbers)))],
    )


def drawn_radii(result: Any, note: Callable[[str], None] | None = None) -> np.ndarray | None:
    """Return the outer radius of each bar (bars,) [m] as it is drawn, None where the result does not have the areas of
    bars; ``note`` receives a remark on bars that are drawn thinner than they are.

    Springs and dashpots between nodes have no section: they are as thin as the thinnest bar.
    """
    if "area" not in getattr(result, "bar_data", ()):
        return None
    names, areas, length = result.field("section", 0), result.field("area", 0), _lengths(result)
    radius = np.full(len(length), np.inf)
    for name, section in result.case.section.items():
        own = np.flatnonzero(names == name)
        radius[own] = bar_shapes(section, length[own], areas[own]).radius
    radius = np.where(np.isfinite(radius), radius, radius.min())
    stout = int(np.count_nonzero(radius > STOUT * length))
    if stout and note is not None:
        note(
            f"{stout} of {len(radius)} bars have a radius above {STOUT:g} of their length "
            f"({radius.max():.3g} m at most), and are drawn with that; --radius-scale changes it"
        )
    return np.minimum(radius, STOUT * length)


def _lengths(result: Any) -> np.ndarray:
    """Return the length of each bar (bars,) in the first snapshot [m]."""
    start, bars = np.asarray(result.positions(0), dtype=float), np.asarray(result.bars)
    return np.linalg.norm(start[bars[:, 1]] - start[bars[:, 0]], axis=1)


def plane(wall: Any, bounds: np.ndarray) -> Surface:
    """Return a slab behind a plane wall, as wide as the projection of the structure on it plus a margin.

    Parameters
    ----------
    wall : has ``name``, ``point`` (3,) [m] and ``normal`` (3,), which points to the allowed side
    bounds : (2, 3) [m], lower and upper corner of the structure's motion
    """
    normal = np.asarray(wall.normal, dtype=float)
    normal = normal / np.linalg.norm(normal)
    first = perpendicular(normal)
    second = np.cross(normal, first)
    along = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T @ np.stack([first, second], axis=1)
    size = np.linalg.norm(bounds[1] - bounds[0]) or 1.0
    # a structure without extent in this direction still gets a visible wall
    margin = 0.04 * size + 0.5 * np.maximum(0.0, 0.2 * size - np.ptp(along, axis=0))
    (a, c), (b, d) = along.min(axis=0) - margin, along.max(axis=0) + margin
    foot = normal * (np.asarray(wall.point, dtype=float) @ normal)
    face = np.array([foot + u * first + v * second for u, v in ((a, c), (b, c), (b, d), (a, d))])
    return slab(wall.name, face, normal, 0.05 * size)


def wall_surfaces(walls: Iterable[Any], bounds: np.ndarray, note: Callable[[str], None] = print) -> list[Surface]:
    """Return the surfaces of a case's walls; a wall whose type has no drawing is skipped with a message to ``note``.

    A wall module may define ``surface(parameters, bounds)``, which returns a :class:`Surface`, or points (n, 3) and
    quadrilaterals (f, 4) or triangles (f, 3).
    """
    drawn = []
    for wall in walls:
        known = wall.type in choices(WALLS)
        module = lookup(WALLS, wall.type, "wall.type") if known else None
        draw = getattr(module, "surface", plane if wall.type == "plane" else None)
        if draw is None:
            why = "defines no function surface" if known else "is unknown; name the file that defines it by --plugin"
            note(f"wall '{wall.name}' is left out of the picture: its type '{wall.type}' {why}")
            continue
        try:
            shape = draw(wall, bounds)
        except InputError as error:  # of a file that is not on this machine, or has changed
            note(f"wall '{wall.name}' is left out of the picture: {error}")
            continue
        if not isinstance(shape, Surface):
            points, faces = (np.asarray(part) for part in shape)
            edge = np.zeros((0, 2), dtype=int)
            shape = Surface(wall.name, points, faces, depth=np.zeros(len(points)), edge=edge)
        drawn.append(shape)
    return drawn


def walls_at(result: Any, times: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacements (times, walls, 3) [m] of a result's walls from where they are first given, their rotations
    (times, walls, 3, 3), and which of them are there (times, walls) bool.

    Positions are interpolated linearly between rows of the history. The end of a stage belongs to it, and not to the
    next one. A wall that a stage no longer has remains where it was.
    """
    walls, history = result.case.every_wall, result.history
    names = [wall.name for wall in walls]
    shifts, present = np.zeros((len(times), len(walls), 3)), np.zeros((len(times), len(walls)), dtype=bool)
    turns = np.tile(np.eye(3), (*present.shape, 1, 1))
    when = np.asarray(history["time"], dtype=float)
    current = stage_at(history, times)
    for number, stage in enumerate(result.case.stages):
        reached = current >= number
        present[reached] = np.isin(names, [wall.name for wall in stage.wall])
        since = np.asarray(times)[reached] - (when[history["stage"] < number].max(initial=0.0) if number else 0.0)
        for wall in (wall for wall in stage.wall if getattr(wall, "rotation", None) is not None):
            axis = np.array(wall.rotation.axis) / np.linalg.norm(wall.rotation.axis)
            angles = rotation_of(wall).at(since)[:, 0, 0]
            turns[reached, names.index(wall.name)] = turns_about(np.tile(axis, (len(angles), 1)), angles)
        for wall in stage.wall if number else ():
            k = names.index(wall.name)
            shifts[reached, k] = _place(wall) - _place(walls[k])
    for k, name in enumerate(names):
        if f"wall/{name}/position" in history:
            places = np.asarray(history[f"wall/{name}/position"], dtype=float)
            shifts[:, k] = np.stack([np.interp(times, when, column - column[0]) for column in places.T], axis=1)
        if f"wall/{name}/rotation" in history:
            kept = np.unique(when, return_index=True)[1]
            rows = Rotation.from_rotvec(np.asarray(history[f"wall/{name}/rotation"], dtype=float)[kept])
            between = Slerp(when[kept], rows) if len(kept) > 1 else lambda at, rows=rows: rows[np.zeros(len(at), int)]
            turns[:, k] = between(np.clip(times, when[0], when[-1])).as_matrix()
    return shifts, turns, present


def _place(wall: Any) -> np.ndarray:
    """The point of a wall at rest whose position is recorded (3,) [m]; zero for a type that is unknown, which is not
    drawn."""
    if getattr(wall, "centre_of_mass", None) is not None:
        return np.asarray(wall.centre_of_mass, dtype=float)
    if wall.type not in choices(WALLS):
        return np.zeros(3)
    return np.asarray(lookup(WALLS, wall.type, "wall.type").Wall(wall).centre, dtype=float)
