"""Results without a run: made-up motion, and result files of a small distributed truss."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyvista
from mpi4py import MPI
from vtkmodules.vtkIOHDF import vtkHDFReader

from pfem_petsc.mesh.distribution import DistributedMesh
from pfem_petsc.output.layout import Contents, Kept
from pfem_petsc.output.units import TIME
from pfem_petsc.output.vtkhdf import ResultWriter

AT_REST = {"velocity": None, "motion": None, "mass": None}
WALL = SimpleNamespace(
    type="plane", name="wall", node_set=None, point=(1.2, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), **AT_REST
)


def ring(bays: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (2 bays, 3) and bars of a ring of two chords with crossed bracing."""
    angle = 2 * np.pi * np.arange(bays) / bays
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    i, j = np.arange(bays), (np.arange(bays) + 1) % bays
    bars = [(i, j), (i + bays, j + bays), (i, i + bays), (i, j + bays), (j, i + bays)]
    return np.concatenate([circle, 0.8 * circle]), np.concatenate([np.stack(pair, axis=1) for pair in bars])


def rod(elements: int = 20) -> tuple[np.ndarray, np.ndarray]:
    points = np.zeros((elements + 1, 3))
    points[:, 0] = np.linspace(0, 1, elements + 1)
    return points, np.stack([np.arange(elements), np.arange(1, elements + 1)], axis=1)


def lattice(n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    points = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(n**3).reshape(n, n, n)
    bars = []
    for step in [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1)]:
        start = index[tuple(slice(0, n - k) for k in step)].ravel()
        bars.append(np.stack([start, index[tuple(slice(k, n) for k in step)].ravel()], axis=1))
    return points, np.concatenate(bars)


class SyntheticCase(SimpleNamespace):
    """A case without stages."""

    self_contact = None

    @property
    def every_wall(self):
        return self.wall

    @property
    def stages(self):
        return (self,)


class SyntheticResult:
    """Interface of :func:`pfem_petsc.open_result` over made-up motion along -``normal`` and back."""

    axis, stretches = TIME, (slice(0, None),)

    def __init__(self, path, points, bars, walls=(WALL,), snapshots=13, end=0.05, title="Ring against a rigid wall"):
        self.path = Path(path)
        self.start, self.bars = points, bars
        self.n_nodes, self.n_bars = len(points), len(bars)
        self.bar_data = ()
        self.point_fields, self.cell_fields = ["displacement", "velocity"], ["plastic_strain", "strain", "stress"]
        self.times = np.linspace(0.0, end, snapshots)
        self.case = SyntheticCase(title=title, name="synthetic", wall=list(walls), stage=(), gravity=None)
        self.case.output = SimpleNamespace(bar_probe=())
        normal = np.array(walls[0].normal if walls else (-1.0, 0.0, 0.0))
        normal = normal / np.linalg.norm(normal)
        away = (points - np.array(walls[0].point if walls else (1.2, 0, 0))) @ normal
        self._normal, self._away, self._end = normal, away, end
        fine = np.linspace(0.0, end, 20 * snapshots)
        push = self._push(fine)
        contact = push > 0
        self.history = {
            "time": fine,
            "step": np.arange(len(fine)),
            "newton_iterations": np.where(contact, 4, 2),
            "linear_iterations": np.where(contact, 60, 20),
            "active_contacts": 2 * contact,
            "kinetic_energy": 100.0 * (1 - 0.8 * (push / push.max()) ** 2),
            "elastic_energy": 80.0 * (push / push.max()) ** 2,
            "plastic_dissipation": np.zeros_like(fine),
            "damping_dissipation": np.zeros_like(fine),
            "external_work": np.zeros_like(fine),
            "contact_work": np.zeros_like(fine),
            "numerical_dissipation": np.zeros_like(fine),
            "momentum": np.outer(np.cos(np.pi * fine / end), -normal) * 40.0,
            "angular_momentum": np.zeros((len(fine), 3)),
            "centre_of_mass": np.outer(fine, normal),
        }
        for wall in walls:
            noise = 1 + 0.8 * np.sin(2e3 * fine / end)
            self.history[f"wall/{wall.name}/force"] = np.outer(3e4 * push / push.max() * noise, normal)
            self.history[f"wall/{wall.name}/contacts"] = 2 * contact
        velocity = np.outer(20 * np.cos(np.pi * fine / end), -normal)
        self.history["probe/tip/velocity"] = np.stack([velocity, 0.5 * velocity], axis=1)
        self.history["probe/tip/position"] = np.cumsum(self.history["probe/tip/velocity"], axis=0) * fine[1]

    def _push(self, time):
        """Return the depth (0 .. ) of the nearest node beyond the wall."""
        return np.clip(1.35 * self._away.min() * np.sin(np.pi * time / self._end) - self._away.min(), 0, None)

    def positions(self, index):
        travel = 1.35 * self._away.min() * np.sin(np.pi * self.times[index] / self._end)
        beyond = np.clip(travel - self._away, 0.0, None)
        moved = self.start - np.outer(travel - beyond, self._normal)
        return moved + 0.3 * beyond[:, None] * (np.array([0, 1.0, 0]) * np.sign(self.start[:, 1:2]))

    def field(self, name, index):
        points = self.positions(index)
        length = [np.linalg.norm(p[self.bars[:, 1]] - p[self.bars[:, 0]], axis=1) for p in (self.start, points)]
        strain = length[1] / length[0] - 1
        if name == "displacement":
            return points - self.start
        if name == "velocity":
            other = self.positions(max(0, index - 1))
            return (points - other) / self.times[1]
        return {"strain": strain, "stress": 2.1e11 * 0.001 * strain, "plastic_strain": np.abs(strain)}[name]


def write_result(folder: Path, snapshots: int = 5) -> Path:
    """Write a real result file of the case ``rod_impact`` with synthetic motion; return its path."""
    from mpi4py import MPI

    from pfem_petsc.case.schema import Case
    from pfem_petsc.output.layout import Contents
    from pfem_petsc.output.vtkhdf import ResultWriter

    case = Case.load("rod_impact")
    points, bars = rod(20)
    made_up = SyntheticResult(folder / "result.vtkhdf", points, bars, case.wall, snapshots, end=5.0)
    block = SimpleNamespace(section=0, start=0, counted=len(bars), stop=len(bars))
    mesh = DistributedMesh.__new__(DistributedMesh)
    mesh.comm, mesh.n_nodes, mesh.n_bars, mesh.n_owned = MPI.COMM_SELF, len(points), len(bars), len(points)
    mesh.blocks, mesh.node_ids = [block], np.arange(len(points))
    mesh.bars, mesh.bar_ids = bars.astype(np.int32), np.arange(len(bars))
    columns = {name: np.dtype((float, np.shape(values)[1:])) for name, values in made_up.history.items()}
    columns["step"] = np.dtype(np.int64)
    contents = Contents(made_up.point_fields, made_up.cell_fields, columns, case.to_toml(), {})
    writer = ResultWriter(made_up.path, MPI.COMM_SELF, mesh, contents)
    for row in range(len(made_up.history["time"])):
        writer.append_history({name: values[row] for name, values in made_up.history.items()})
    for i, time in enumerate(made_up.times):
        fields = [
            {name: made_up.field(name, i) for name in names} for names in (made_up.point_fields, made_up.cell_fields)
        ]
        writer.write_snapshot(time, i, made_up.positions(i), *fields)
    writer.close()
    return made_up.path


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
        self.mesh = DistributedMesh.__new__(DistributedMesh)
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


COMM = MPI.COMM_WORLD
STEPS = range(23)


def write_all(path, comm=COMM, **changes):
    truss = Truss(comm, idle=(1,) if comm.size > 1 else ())
    with ResultWriter(path, comm, truss.mesh, **options(**changes)) as writer:
        write(writer, truss, STEPS)
    return truss


def read_with_vtk(path, step):
    """Return the grid of a step, and the number of steps, by the reader of VTK."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.SetStep(step)
    reader.Update()
    return pyvista.wrap(reader.GetOutputDataObject(0)), reader.GetNumberOfSteps()


def assert_grid_is(grid, truss, step):
    points, point_data, cell_data = truss.whole(step)
    np.testing.assert_array_equal(grid.points, points)
    np.testing.assert_array_equal(grid.cells.reshape(-1, 3)[:, 1:], truss.ends)
    assert set(grid.celltypes) == {pyvista.CellType.LINE}
    assert sorted(grid.point_data) == sorted(point_data)
    assert sorted(grid.cell_data) == sorted(cell_data)
    for name, values in point_data.items():
        np.testing.assert_array_equal(grid.point_data[name], values)
    for name, values in cell_data.items():
        np.testing.assert_array_equal(grid.cell_data[name], values)


def assert_history_is(history, truss, steps):
    assert sorted(history) == sorted(truss.row(0))
    for name in history:
        np.testing.assert_array_equal(history[name], [truss.row(step)[name] for step in steps])
