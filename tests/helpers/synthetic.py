"""Results without a run: a structure that flies into a wall and back, with the interface of an open result."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pfem_petsc.mesh.distribution import DistributedMesh
from pfem_petsc.output.units import TIME

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

    @property
    def every_wall(self):
        return self.wall

    @property
    def stages(self):
        return (self,)


class SyntheticResult:
    """Interface of :func:`pfem_petsc.open_result` over made-up motion along -``normal`` and back."""

    axis = TIME

    def __init__(self, path, points, bars, walls=(WALL,), snapshots=13, end=0.05, title="Ring against a rigid wall"):
        self.path = Path(path)
        self.start, self.bars = points, bars
        self.n_nodes, self.n_bars = len(points), len(bars)
        self.point_fields, self.cell_fields = ["displacement", "velocity"], ["plastic_strain", "strain", "stress"]
        self.times = np.linspace(0.0, end, snapshots)
        self.case = SyntheticCase(title=title, name="synthetic", wall=list(walls), stage=(), gravity=None)
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
    mesh = DistributedMesh()
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
