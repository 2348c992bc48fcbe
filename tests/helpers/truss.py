"""A small distributed truss with the attributes of a DistributedMesh, and results that all ranks know."""

from types import SimpleNamespace

import numpy as np

from pfem_petsc.mesh.distribution import DistributedMesh
from pfem_petsc.output.layout import Contents, Kept

COLUMNS = {
    "time": np.dtype(float),
    "step": np.dtype(np.int64),
    "newton_iterations": np.dtype(np.int32),
    "momentum": np.dtype((float, (3,))),
    "wall/floor/force": np.dtype((float, (3,))),
    "probe/tip/position": np.dtype((float, (2, 3))),
}
POINT_FIELDS, CELL_FIELDS = ["displacement", "contact_force", "reached"], ["stress", "section"]


class Truss:
    """A closed chain of bars with random chords; nodes are owned by chance, or all but those of ``idle`` ranks."""

    def __init__(self, comm, n_nodes=23, n_bars=41, idle=()):
        self.comm, self.n_nodes, self.n_bars = comm, n_nodes, n_bars
        random = np.random.default_rng(5)
        starts = np.arange(n_bars) % n_nodes
        self.ends = np.column_stack([starts, (starts + 1 + np.arange(n_bars) // n_nodes) % n_nodes])
        self.reference = random.random((n_nodes, 3))
        owner = random.choice([r for r in range(comm.size) if r not in idle], size=n_nodes)
        section = random.integers(3, size=n_bars)

        owned = random.permutation(n_nodes)
        owned = owned[owner[owned] == comm.rank]
        mine = np.nonzero((owner[self.ends] == comm.rank).any(axis=1))[0]
        ghosts = np.setdiff1d(self.ends[mine], owned)
        node_ids = np.concatenate([owned, ghosts]).astype(np.int64)
        local = np.full(n_nodes, -1)
        local[node_ids] = np.arange(len(node_ids))
        bar_ids, blocks = [], []
        for s in range(3):
            for counted in (True, False):
                here = mine[(section[mine] == s) & ((owner[self.ends[mine, 0]] == comm.rank) == counted)]
                bar_ids.append(random.permutation(here) if comm.size == 1 else here)
            start = sum(map(len, bar_ids[:-2]))
            blocks.append(SimpleNamespace(section=s, start=start, counted=start + len(bar_ids[-2])))
            blocks[-1].stop = blocks[-1].counted + len(bar_ids[-1])
        self.mesh = DistributedMesh()
        self.mesh.comm, self.mesh.n_nodes, self.mesh.n_bars = comm, n_nodes, n_bars
        self.mesh.n_owned, self.mesh.blocks = len(owned), blocks
        self.mesh.node_ids, self.mesh.bar_ids = node_ids, np.concatenate(bar_ids).astype(np.int64)
        self.mesh.bars = local[self.ends[self.mesh.bar_ids]].astype(np.int32)
        self.owned, self.local_bars = owned, self.mesh.bar_ids

    def whole(self, step):
        """Points, point data and cell data of a step in mesh numbering."""
        wave = np.sin(0.1 * step + np.arange(3 * self.n_nodes)).reshape(-1, 3)
        point_data = {
            "displacement": wave,
            "contact_force": 1e3 * wave**2,
            "reached": (np.arange(self.n_nodes) + step) % 5,
        }
        cell_data = {"stress": np.cos(step + np.arange(self.n_bars)), "section": np.arange(self.n_bars, dtype=np.int32)}
        return self.reference + wave, point_data, cell_data

    def snapshot(self, step):
        """Return this rank's arguments of ``write_snapshot``; values of bars not counted here are invalid."""
        points, point_data, cell_data = self.whole(step)
        cells = {name: values[self.local_bars].copy() for name, values in cell_data.items()}
        for block in self.mesh.blocks:
            for values in cells.values():
                values[block.counted : block.stop] = -77
        return points[self.owned], {name: values[self.owned] for name, values in point_data.items()}, cells

    def row(self, step):
        """A history row."""
        return {
            "time": 0.01 * step,
            "step": step,
            "newton_iterations": step % 4,
            "momentum": np.array([step, -step, 0.5]),
            "wall/floor/force": [0.0, 0.0, 2.0 * step],
            "probe/tip/position": np.full((2, 3), float(step)),
        }


def options(append_after_step=None, **changes):
    """Arguments of a ResultWriter for these results; ``changes``: of their contents."""
    given = {"point_fields": POINT_FIELDS, "cell_fields": CELL_FIELDS, "columns": COLUMNS}
    given |= {"case_text": 'title = "A truss, tiny"\n', "attributes": {"command": "test", "argv": [1, 2]}}
    step = append_after_step
    return {"contents": Contents(**given | changes), "kept": None if step is None else Kept(step, step, step)}


def write(writer, truss, steps, every=5):
    """Record each step, with a snapshot at each ``every``-th."""
    for step in steps:
        writer.append_history(truss.row(step) if truss.comm.rank == 0 else None)
        if step % every == 0:
            writer.write_snapshot(0.01 * step, step, *truss.snapshot(step))
