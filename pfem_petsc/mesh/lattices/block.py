"""A box of unit cells: numbers, places and joints of its nodes and bars, each from its number alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..slab import check_size
from .cell import UnitCell
from .numbering import CellByCell, ItemByItem, Numbering, Places

__all__ = ["FACES", "Block"]

FACES = (("left", "right"), ("front", "back"), ("bottom", "top"))
"""Names of the lower and upper faces normal to x, y and z."""

Levels = list[float | np.ndarray]
Move = Callable[[np.ndarray, np.ndarray, Places], np.ndarray]


class Block:
    """Cells in a box, of which no rank has more than what it asks for.

    Parameters
    ----------
    cell : UnitCell
    cells : (3,) int
        Number of cells along each axis, or of layers where a cell has several.
    levels : for each axis float, or (cells + 2,) float64 [m]
        The edge of all cells, or the coordinates of their borders and of one more.
    closed : bool
        Whether the last cell along x is joined to the first.
    plain : bool
        Whether the numbering of the cell may be item by item.
    """

    moves: list[Move]
    """Called one after another with coordinates (n, 3), numbers and places of nodes; return other coordinates."""

    def __init__(
        self, cell: UnitCell, cells: np.ndarray, levels: Levels, closed: bool = False, plain: bool = True
    ) -> None:
        self.cell, self.cells, self.levels, self.closed = cell, np.asarray(cells, np.int64), levels, closed
        self.moves = []
        size = self.cells / np.array(cell.layers)
        nodes = np.floor(size - cell.points + 1e-9).astype(np.int64).clip(min=-1) + 1
        bars = (nodes[cell.ends] - cell.offsets).min(axis=1).clip(min=0)
        if closed:
            nodes[:, 0] = bars[:, 0] = self.cells[0]
        n_nodes, n_bars = (int(counts.astype(object).prod(axis=1).sum()) for counts in (nodes, bars))
        check_size(n_nodes, "mesh.cells", n_bars)
        number: type[Numbering] = ItemByItem if plain and cell.item_by_item else CellByCell
        self.nodes, self.bars = number(nodes), number(bars)
        there = (nodes > 0).all(axis=1)
        self._low = cell.points[there].min(axis=0, initial=np.inf)
        self._high = (cell.points + nodes - 1)[there].max(axis=0, initial=-np.inf)

    def extents(self) -> np.ndarray:
        """Return the edges (3,) [m] of the block before it is moved."""
        found = []
        for axis, level in enumerate(self.levels):
            size = self.cells[axis] / self.cell.layers[axis]
            if isinstance(level, float):
                found.append(size * level)
            else:
                whole = int(size)
                found.append(level[whole] + (size - whole) * (level[whole + 1] - level[whole]))
        return np.array(found)

    def positions(self, numbers: np.ndarray, places: Places) -> np.ndarray:
        """Return the positions (n, 3) [m] of nodes with given numbers and places."""
        points = np.empty((len(numbers), 3))
        for axis, index in enumerate(places[1:]):
            level, at = self.levels[axis], self.cell.points[places.item, axis]
            if isinstance(level, float):
                points[:, axis] = (index + at) * level
            else:
                points[:, axis] = level[index] + at * (level[index + 1] - level[index])
        for move in self.moves:
            points = move(points, numbers, places)
        return points

    def end(self, places: Places, which: int) -> tuple[np.ndarray, Places]:
        """Return numbers and places of the first or second (``which`` = 0, 1) ends of bars.

        Where the block is closed, a place may be one cell beyond the last.
        """
        item, offset = places.item, self.cell.offsets[places.item, which]
        at = Places(self.cell.ends[item, which], *(index + offset[..., axis] for axis, index in enumerate(places[1:])))
        i = at.i % self.cells[0] if self.closed else at.i
        return self.nodes.encode(at.item, i, at.j, at.k), at

    def on_face(self, places: Places, axis: int, upper: bool) -> np.ndarray:
        """Return which nodes (n,) are on an outer face: those farthest along the axis."""
        if axis == 0 and self.closed:
            return np.zeros(len(places.i), bool)
        at = places[1 + axis] + self.cell.points[places.item, axis]
        return at == (self._high if upper else self._low)[axis]

    def groups_of(self, bars: Places) -> dict[str, np.ndarray]:
        """Return which bars (n,) are in each bar group."""
        skin = np.zeros(len(bars.i), bool)
        for name in self.cell.skin:
            axis = "xyz".index(name)
            for upper in (False, True):
                skin |= self.on_face(self.end(bars, 0)[1], axis, upper) & self.on_face(
                    self.end(bars, 1)[1], axis, upper
                )
        found = {}
        for name, members in self.cell.groups.items():
            one = np.zeros(len(self.cell.ends), bool)
            one[members] = True
            found[name] = one[bars.item] & ~skin if np.ndim(bars.item) else np.full(len(skin), one[bars.item]) & ~skin
        return found | ({"skin": skin} if self.cell.skin else {})

    def has_bare_nodes(self) -> bool:
        """Whether a node at a corner, an edge or a face of the block has no bar."""
        counts = np.array(self.cell.layers) * 3
        small = np.where(self.cells > counts, counts + self.cells % self.cell.layers, self.cells)
        block = Block(self.cell, small, self.levels, self.closed)
        used = np.zeros(block.nodes.total, bool)
        for _, bars in block.bars.pieces(0, block.bars.total):
            used[block.end(bars, 0)[0]] = used[block.end(bars, 1)[0]] = True
        return not used.all()
