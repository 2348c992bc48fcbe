"""The film of one result, or of several side by side: colours, cameras, and the page of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError
from .contrast import MARKS
from .fields import ColourField, ColourScale
from .inset import Inset, insets_of
from .motion import Motion
from .page import Page, lay_over
from .poster import grid, instants
from .scene import Scene, Style
from .shots import Moves, at_one_scale, shots

__all__ = ["Film", "Look"]

_POSTER = (1600, 900)
_TILES = 6
_FEW = 2000  # bars of a small model
_ROOM = 220  # pixels: the narrowest tile with an inset


@dataclass(frozen=True)
class Look:
    """The look of a film, independent of its content.

    Parameters
    ----------
    styles : how the bars of each result are drawn
    moves : of the camera
    marks : what is marked
    inset : column of the history, None for none
    labels : of the results, when there are several
    transparent : whether the background is
    """

    styles: Sequence[Style]
    moves: Moves
    marks: Sequence[str] = ()
    inset: str | None = None
    labels: Sequence[str] = field(default_factory=tuple)
    transparent: bool = False


class Film:
    """Frames of results, side by side when there are several; all have the same number of frames.

    Parameters
    ----------
    motions, colours : of each result
    scale : colours of all
    title : of the page
    look : what it looks like
    """

    def __init__(
        self,
        motions: Sequence[Motion],
        colours: Sequence[ColourField],
        scale: ColourScale,
        title: str,
        look: Look,
    ) -> None:
        self.motions, self.colours, self.scale, self.title, self.look = motions, colours, scale, title, look
        self.count = len(motions[0].frames)
        for motion, style in zip(motions, look.styles, strict=True):
            if style.radius is not None and len(style.radius):
                motion.reach = 1.2 * float(style.radius.max())  # balls of nodes are that much wider than bars

    def start(self, size: tuple[int, int]) -> None:
        """Prepare frames of a size."""
        _, _, width, height = Page.region_of(size)
        aspect = np.mean([self._aspect(motion) for motion in self.motions])
        self._columns, self._tile = 1, (width, height)
        several = len(self.motions) > 1
        if several:
            self._columns, rows = grid(len(self.motions), float(aspect), (width, height))
            self._tile = (width // self._columns, height // rows - Page.strip_of(size))
        self._cameras = self._shots(self._tile)
        self._page = self._new_page(size, self._cameras[0][0], self._tile[1])
        self._scenes = self._new_scenes(size, self._tile, self._cameras)
        self._insets: list[Inset] = []
        if self.look.inset is not None:
            if several and self._tile[0] < _ROOM:
                raise InputError(
                    f"render: inset needs tiles of {_ROOM} pixels or more, and these have {self._tile[0]}: give a "
                    "larger size, or fewer results"
                )
            room, self._corner = self._room_of_insets(several)
            self._insets = insets_of([motion.result for motion in self.motions], self.look.inset, room)

    def frame(self, number: int) -> np.ndarray:
        """Return a page (height, width, 3 or 4) uint8."""
        drawings = [self._draw(k, number, self._scenes[k], self._cameras[k]) for k in range(len(self.motions))]
        for motion, inset, drawing in zip(self.motions, self._insets, drawings, strict=False):
            picture, (x, y) = inset.at(float(motion.times[number])), self._corner
            lay_over(drawing[y : y + picture.shape[0], x : x + picture.shape[1]], picture)
        motion, camera = self.motions[0], self._cameras[0][number]
        time = motion.time(motion.frames[number])
        if len(drawings) > 1:
            return self._page.compose_tiles(drawings, list(self.look.labels), self._columns, camera, time)
        return self._page.compose(drawings[0], time, camera)

    def poster(self) -> np.ndarray:
        """Return six instants on one page, in a grid that suits the shape of the motion."""
        motion, several = self.motions[0], len(self.motions) > 1
        own = getattr(motion.result, "instants", None)
        wanted = max(2, _TILES // len(self.motions))
        chosen = instants(motion.result, motion.frames, wanted) if own is None else own(wanted)
        numbers = [motion.frames.index(frame) for frame in chosen]
        _, _, width, height = Page.region_of(_POSTER)
        columns, rows = grid(len(chosen), self._aspect(motion), (width, height))
        if several:
            columns, rows = len(chosen), len(self.motions)
        tile = (width // columns, height // rows - Page.strip_of(_POSTER))
        cameras = self._shots(tile)
        page = self._new_page(_POSTER, cameras[0][0], tile[1])
        scenes = self._new_scenes(_POSTER, tile, cameras)
        drawings, texts = [], []
        for k in range(len(self.motions)):
            for number, frame in zip(numbers, chosen, strict=True):
                drawings.append(self._draw(k, number, scenes[k], cameras[k]))
                texts.append(f"{self.look.labels[k]}, {motion.time(frame)}" if several else motion.time(frame))
        return page.compose_tiles(drawings, texts, columns)

    def _draw(self, k: int, number: int, scene: Scene, cameras: list[Any]) -> np.ndarray:
        motion, colour, camera = self.motions[k], self.colours[k], cameras[number]
        frame = motion.frames[number]
        shades = self.scale.colours(colour.values(frame))
        layers = motion.layers(frame, scene, camera)
        surfaces, gone = motion.surfaces[frame], motion.gone(frame)
        return scene.draw(motion.positions(frame), shades, colour.on_nodes, camera, surfaces, gone, layers)

    def _shots(self, tile: tuple[int, int]) -> list[list[Any]]:
        films = [shots(motion, self.look.moves, tile[0] / tile[1]) for motion in self.motions]
        return at_one_scale(films) if len(films) > 1 and self.look.moves.path is None else films

    def _new_scenes(self, size: tuple[int, int], tile: tuple[int, int], cameras: list[list[Any]]) -> list[Scene]:
        made = []
        _, _, width, height = Page.region_of(size)
        share = tile[0] * tile[1] / (width * height)
        for motion, style, film in zip(self.motions, self.look.styles, cameras, strict=True):
            # widths are those of bars at the closest
            closest = min(film, key=lambda camera: camera.half_height)
            bounds, bars = motion.bounds, motion.bars
            # lines of a small model stay visible in a tile; those of a large one would merge
            unit = min(size[0] / 1280, size[1] / 720) * share ** (0.25 if len(bars) <= _FEW else 0.5)
            made.append(Scene(motion.start, bars, closest, bounds, tile, style, self.look.transparent, unit))
        return made

    def _new_page(self, size: tuple[int, int], camera: Any, height: int) -> Page:
        legend = [(MARKS[mark].text, MARKS[mark].colour) for mark in self.look.marks]
        still = self.look.moves.path is None
        options: dict[str, Any] = {"still": still, "transparent": self.look.transparent, "legend": legend}
        return Page(size, self.title, self.colours[0].title, self.scale, camera, height, **options)

    def _aspect(self, motion: Motion) -> float:
        """Return the width of the motion over its height, in the picture."""
        look, points = shots(motion, self.look.moves, 1.0)[0], motion.surroundings
        across, along = (float(np.ptp(points @ way)) for way in (look.right, look.up))
        return across / max(along, 1e-3 * across, 1e-300)

    def _room_of_insets(self, several: bool) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the size of insets, and the corner where they cover least of structures and walls over the film."""
        width, height = self._tile
        best = np.inf
        for share in (0.28, 0.25):
            wide = max(share * width, min((0.5 if several else 1.0) * width, 220.0))
            room = round(wide), round(0.62 * wide)
            places = [(x, y) for y in (0, height - room[1]) for x in (0, width - room[0])]
            covered = np.zeros(len(places))
            for motion, cameras in zip(self.motions, self._cameras, strict=True):
                for number in np.unique(np.linspace(0, self.count - 1, 7).astype(int)):
                    covered += self._covered(motion, motion.frames[number], cameras[number], places, room)
            if covered.min() < best:
                best, found = covered.min(), (room, places[int(np.argmin(covered))])
        return found

    def _covered(
        self, motion: Motion, frame: int, camera: Any, places: Sequence[tuple[int, int]], room: tuple[int, int]
    ) -> np.ndarray:
        """Return how much of the bars is in each place, and a little for each wall that is."""
        ends = motion.positions(frame)[motion.bars]
        along = np.concatenate([ends[:, 0] + part * (ends[:, 1] - ends[:, 0]) for part in (0.0, 0.3, 0.6)])
        x, y, _, _ = camera.project(along, self._tile)
        inside = [(x > a) & (x < a + room[0]) & (y > b) & (y < b + room[1]) for a, b in places]
        covered = np.array([float(each.mean()) for each in inside])
        for surface in motion.surfaces[frame]:
            x, y, _, _ = camera.project(np.asarray(surface.points), self._tile)
            for k, (a, b) in enumerate(places):
                overlap = x.min() < a + room[0] and x.max() > a and y.min() < b + room[1] and y.max() > b
                covered[k] += 1e-3 * overlap
        return covered
