"""What acts on a truss, as the symbols of engineering drawings: triangles for supports, arrows for loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..mechanics.supports import directions_of
from ..output.units import engineering
from .camera import Camera
from .members import check_mesh
from .scene import NODE_COLOUR, Layer

MOST = 40
"""Nodes with symbols; of more, some of them, at distances."""
_SIZE, _ARROW, _HEAD = 0.03, 0.14, 0.022  # of the diagonal of the truss: supports, the largest load, heads of arrows
_APART = 0.05  # of the diagonal: about the distance of symbols where there are many nodes
_FRONT = 700.0  # pixels of a page of 1280 by 720: symbols are before the truss
_SMALL = 0.02  # of the largest load: smaller ones have no arrow
_ALONG = 0.999  # cosine from which a direction is that of the view


class Acting(NamedTuple):
    """What acts at a time: loads (nodes, 3) [N], gravity [m/s2] and wind [m/s], (3,), and the number of the stage."""

    stage: int
    loads: np.ndarray
    gravity: np.ndarray
    wind: np.ndarray


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

        stages, self._result = result.case.stages, result
        model = Model(stages[0], MPI.COMM_SELF, later=stages[1:])
        check_mesh(result, model.mesh)
        models = [model, *(Model(stage, MPI.COMM_SELF, model.mesh) for stage in stages[1:])]
        self._ids, self._centre, self.notes = model.mesh.node_ids[: model.mesh.n_owned], bounds.mean(axis=0), []
        self._diagonal, self.size = float(np.linalg.norm(bounds[1] - bounds[0])), 0.0
        self._supports: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in stages]
        self._acting: list[Acting] = []
        if "supports" in kinds:
            self.size = 1.5 * _SIZE * self._diagonal
            for stage, own, found in zip(stages, models, self._supports, strict=True):
                found += [(self._ids[own.nodes[each.node_set]], directions_of(each)[0]) for each in stage.support]
            nodes = [numbers for each in self._supports for numbers, _ in each]
            self._shown = self._thinned(np.unique(np.concatenate([np.zeros(0, dtype=int), *nodes])), "supported")
        acting = self._forces(models, times)
        self._stages = [each.stage for each in acting]
        self._acting = acting if "loads" in kinds else []
        sizes = [np.linalg.norm(each.loads, axis=1) for each in self._acting]
        self._largest = max((float(size.max()) for size in sizes), default=0.0)
        self._loaded = np.zeros(0, dtype=int)
        if self._largest > 0.0:
            self.notes.append(f"longest arrow {engineering(self._largest, 'N', 3)}")
            rows = np.flatnonzero(np.any([size > _SMALL * self._largest for size in sizes], axis=0))
            self._loaded = self._thinned(rows, "loaded")

    def _thinned(self, nodes: np.ndarray, what: str) -> np.ndarray:
        """Return nodes for symbols, of many one in each cell of a grid."""
        if len(nodes) <= MOST:
            return nodes
        cells = np.floor((np.asarray(self._result.positions(0))[nodes] - self._centre) / (_APART * self._diagonal))
        some = nodes[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
        self.notes.append(f"symbols at {len(some):,} of {len(nodes):,} {what} nodes")
        return some

    def _forces(self, models: Sequence[Any], times: np.ndarray) -> list[Acting]:
        """Return what acts at times; each stage takes over what acts at the end of the one that it starts from."""
        history, stages = self._result.history, self._result.case.stages
        when = np.asarray(history["time"], dtype=float)
        of_row = np.asarray(history["stage"]) if "stage" in history else np.zeros(len(when), dtype=int)
        factors = np.asarray(history.get("load_factor", when), dtype=float)

        def at(number: int, time: float) -> Acting:
            rows, external = of_row == number, models[number].external
            begin = float(when[of_row < number].max(initial=0.0))
            if stages[number].static is None:
                own = time - begin
            elif number:  # whose history has no row of its start
                own = float(np.interp(time, [begin, *when[rows]], [0.0, *factors[rows]]))
            else:
                own = float(np.interp(time, when[rows], factors[rows]))
            loads = np.zeros_like(external.loads_at(own))
            loads[self._ids] = external.loads_at(own)
            return Acting(number, loads, external.gravity_at(own), external.wind_at(own))

        for number in range(1, len(models)):
            first = stages[number].starts_from
            before = number - 1 if first is None else first
            if np.any(of_row == number):
                _, loads, *held = at(before, float(when[of_row == before][-1]))
                models[number].external.hold(loads[self._ids], *held, True)
        return [at(int(of_row[min(np.searchsorted(when, time), len(when) - 1)]), float(time)) for time in times]

    def everywhere(self, number: int) -> dict[str, np.ndarray]:
        """Gravity and wind (3,) of a frame, if there are any, by their names."""
        if not self._acting:
            return {}
        ways = {"g": self._acting[number].gravity, "wind": self._acting[number].wind}
        return {name: way / np.linalg.norm(way) for name, way in ways.items() if way.any()}

    def arrows(self, number: int, points: np.ndarray) -> np.ndarray:
        """Return tails and tips (2, n, 3) [m] of the loads of a frame, at points (nodes, 3) [m].

        Loads that pull the truss outwards have their tails at the nodes, the others their tips.
        """
        if not len(self._loaded):
            return np.zeros((2, 0, 3))
        force = self._acting[number].loads[self._loaded] / self._largest
        kept = np.linalg.norm(force, axis=1) > _SMALL
        force, at = force[kept], points[self._loaded[kept]]
        way = _ARROW * self._diagonal * force
        outwards = ((at - self._centre) * force).sum(axis=1, keepdims=True) > 0.0
        return np.stack([np.where(outwards, at, at - way), np.where(outwards, at + way, at)])

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
        return [_lines(pairs, 2.2), _lines(self._triangles(self._stages[number], points, camera), 1.5)]

    def _triangles(self, stage: int, points: np.ndarray, camera: Camera) -> list[np.ndarray]:
        """Return the lines (n, 2, 3) of supports: one triangle with strokes below where all seen directions are
        held; else one for each direction, with a second line, along which the node may move."""
        held: dict[int, list[np.ndarray]] = {}
        for nodes, directions in self._supports[stage]:
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


def _lines(pairs: Sequence[np.ndarray], width: float) -> Layer:
    """Return a layer of lines, as pairs of points (n, 2, 3) [m]."""
    points = np.concatenate([np.zeros((0, 2, 3)), *pairs]).reshape(-1, 3)
    return Layer(points, np.arange(len(points)).reshape(-1, 2), NODE_COLOUR, width, _FRONT)
