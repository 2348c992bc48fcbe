"""What acts on a truss, as the symbols of engineering drawings: triangles for supports, arrows for loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..mechanics.supports import directions_of
from ..output.result import stage_at
from ..output.units import engineering
from .scene import NODE_COLOUR, Camera, Layer

MOST = 40
"""Nodes with symbols; of more, some of them, at distances."""
_SIZE, _ARROW, _HEAD = 0.03, 0.14, 0.022  # of the diagonal of the truss: supports, the longest arrow, its head
_APART = 0.05  # of the diagonal: the least distance of symbols, about, where there are many nodes
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
        self.size = 1.5 * _SIZE * self._diagonal if "supports" in kinds else 0.0
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
        """Return nodes for symbols, of many those nearest to the middles of the cells of a grid."""
        some, apart = nodes, _APART * self._diagonal
        while len(some) > MOST:
            places = (self._start[nodes] - self._centre) / apart
            order = np.argsort(np.linalg.norm(places - np.round(places), axis=1).round(6), kind="stable")
            some = nodes[np.sort(order[np.unique(np.round(places[order]), axis=0, return_index=True)[1]])]
            apart *= 1.1
        if len(some) == len(nodes):
            return nodes
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
        size, every = _SIZE * self._diagonal, 2 if camera.parallel else 3
        upward = np.eye(3)[np.argmax(np.abs(camera.up))] * np.sign(camera.up[np.argmax(np.abs(camera.up))])
        for node, ways in held.items():
            at = points[node]
            fixed = len(ways) >= every
            for way in [upward] if fixed else ways:
                side = way @ upward if abs(way @ upward) > 0.5 else (self._centre - at) @ way
                away = -way if side >= 0.0 else way
                across = np.cross(away, camera.towards)
                across = 0.55 * across / max(float(np.linalg.norm(across)), 1e-300)
                one, two = at + size * (away + across), at + size * (away - across)
                lines += [np.array([[at, one], [one, two], [two, at]])]
                if fixed:
                    starts = np.linspace(one, two, 5)[:-1]
                    lines += [np.stack([starts, starts + 0.3 * size * (away - across)], axis=1)]
                else:
                    lines += [np.array([[one, two]]) + 0.3 * size * away]
        return lines


def check_mesh(result: Any, mesh: Any) -> None:
    """Refuse a mesh that is not the one of a result.

    Raises
    ------
    InputError
        If nodes or bars differ.
    """
    ends, numbers = np.asarray(result.bars), mesh.node_ids[mesh.bars]
    counts = (result.n_nodes, len(ends)), (mesh.n_nodes, mesh.n_bars)
    same = counts[0] == counts[1] and bool((ends[mesh.bar_ids] == numbers).all())
    if same and "displacement" in result.point_fields:
        points = np.asarray(result.positions(0), dtype=float) - np.asarray(result.field("displacement", 0), dtype=float)
        size = float(np.ptp(mesh.points, axis=0).max())
        same = bool(np.abs(points[mesh.node_ids] - mesh.points).max() <= 1e-5 * size)
    if not same:
        raise InputError(
            f"{result.path}: the mesh of its case is another one now (it had {counts[0][0]:,} nodes and "
            f"{counts[0][1]:,} bars): the table of members reads it again; put it back, or run the case again"
        )


def _lines(pairs: Sequence[np.ndarray], width: float) -> Layer:
    """Return a layer of lines, as pairs of points (n, 2, 3) [m]."""
    points = np.concatenate([np.zeros((0, 2, 3)), *pairs]).reshape(-1, 3)
    return Layer(points, np.arange(len(points)).reshape(-1, 2), NODE_COLOUR, width, _FRONT)
