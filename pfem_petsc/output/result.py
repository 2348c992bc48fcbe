"""Reads the results of a finished, running or killed run."""

from __future__ import annotations

import html
import re
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import h5py
import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..registry import nearest
from .hdf5 import HDF5_ERRORS, dataset_names, first_line
from .layout import (
    BARS,
    EVENT,
    MODE_VALUES,
    MODES,
    check_version,
    complete_modes,
    complete_rows,
    complete_snapshots,
    constants,
    field_names,
    mesh_sizes,
    read_attributes,
)
from .table import SWEEP, Table, aligned, flat_columns, html_table, select
from .units import AXES, LOAD_FACTOR, TIME, Axis, engineering

if TYPE_CHECKING:
    import pyvista

    from ..case.schema import Case


class History(Mapping[str, np.ndarray]):
    """Columns of the history by name, one row per recorded step: ``history["kinetic_energy"]``.

    Names with slashes can be accessed by parts: ``history["wall"]["floor"]["force"]`` or ``history.wall.floor.force``.
    """

    def __init__(self, result: Result, columns: list[str], n_rows: int, prefix: str = "") -> None:
        self.n_rows = n_rows
        self._result, self._columns, self._prefix = result, columns, prefix
        self._names = [name.removeprefix(prefix) for name in columns if name.startswith(prefix)]

    def __getitem__(self, name: str) -> Any:
        if name in self._names:
            return self._result.column(self._prefix + name, self.n_rows)
        if any(known.startswith(f"{name}/") for known in self._names):
            return History(self._result, self._columns, self.n_rows, f"{self._prefix}{name}/")
        raise KeyError(f"{self._result.path}: history has no {self._prefix}{name}{nearest(name, self._names)}")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(str(error)) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Modes:
    """Natural vibrations or buckling modes, the lowest first; read when asked for.

    Attributes
    ----------
    kind : "vibration" or "buckling"
    """

    def __init__(self, result: Result, names: list[str]) -> None:
        self._result, self._kept = result, names
        self.kind = next(kind for kind, (name, _) in MODE_VALUES.items() if name in names)

    def __len__(self) -> int:
        return self._result.n_modes

    @property
    def frequency(self) -> np.ndarray:
        """(modes,) [Hz]; negative where the state is unstable: minus the growth rate over 2 pi."""
        return self._read("frequency")

    @property
    def load_factor(self) -> np.ndarray:
        """(modes,) factors of the state's axial forces at which the truss buckles."""
        return self._read("load_factor")

    @property
    def eigenvalue(self) -> np.ndarray:
        """(modes,) squared circular frequencies [1/s2], or load factors."""
        return self._read("eigenvalue")

    @property
    def values(self) -> np.ndarray:
        """(modes,) :attr:`frequency` or :attr:`load_factor`."""
        return self._read(MODE_VALUES[self.kind][0])

    @property
    def shape(self) -> np.ndarray:
        """(modes, nodes, 3): with x^T M x = 1 [kg^-1/2], of buckling with a largest component of 1."""
        return self._read("shape")

    def label(self, k: int) -> str:
        """Text of mode k, from 0: ``"mode 3: 149.4 Hz"``."""
        name, unit = MODE_VALUES[self.kind]
        text = f"{self.values[k]:.6g} {unit}".rstrip()
        return f"mode {k + 1}: {text}" if unit else f"mode {k + 1}: {name.replace('_', ' ')} {text}"

    def table(self) -> Table:
        """Numbers of the modes from 1, and their frequencies or load factors."""
        name, unit = MODE_VALUES[self.kind]
        heading = name.replace("_", " ") + (f" [{unit}]" if unit else "")
        return Table({"mode": np.arange(1, len(self) + 1), heading: self.values})

    def _read(self, name: str) -> np.ndarray:
        if name not in self._kept:
            raise InputError(f"{self._result.path}: modes of {self.kind} have no {name}{nearest(name, self._kept)}")
        return self._result.read(f"{MODES}/{name}", slice(0, self._result.n_modes))


RESULT_NAME = "result.vtkhdf"
# A file that is being written may be read between two states: number of attempts, and seconds between them.
ATTEMPTS, PAUSE = 8, 0.15

T = TypeVar("T")


def open_result(path: Path | str) -> Result:
    """Open a result file, or that of a folder, for reading, also during the run.

    Raises
    ------
    InputError
        If there is no such file, or it is not a readable result of pfem_petsc.
    """
    return Result(result_file(path))


def result_file(path: Path | str) -> Path:
    """Return the result file of a folder, or the file itself."""
    path = Path(path)
    return path / RESULT_NAME if path.is_dir() else path


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Context that converts errors in reading a result file to an InputError."""
    sweep = path.name == SWEEP or (path.name == RESULT_NAME and not path.exists())
    if sweep and (path.parent / SWEEP).is_file():
        runs = f"{path.parent}/*/"
        raise InputError(f"{path}: is no result, but in the folder of a sweep: the results of its runs are {runs}")
    if not path.is_file():
        raise InputError(f"{path}: there is no such result file; give a {RESULT_NAME} or the folder that holds one")
    try:
        yield
    except HDF5_ERRORS as error:
        if not h5py.is_hdf5(path):
            raise InputError(f"{path}: not a result file: it is not HDF5, or cut off at its beginning") from error
        raise InputError(f"{path}: not a result of pfem_petsc, or damaged: {first_line(error)}") from error


class Result:
    """The results of a run. Fields are in mesh numbering; an incomplete snapshot is not visible.

    The content is listed once, and again by :meth:`reload`. The file is open only during a read, because HDF5 does not
    show data that a run has written since the process opened the file.

    Attributes
    ----------
    path : Path
    times : (snapshots,) float64 [s]
    steps : (snapshots,) int64
        Numbers of the time steps.
    n_nodes, n_bars : int
    point_fields, cell_fields : list of str
    bar_data : list of str
        Names of what bars have in all snapshots: ``section``, ``material``, ``area``, ``group:NAME``.
    case_text : str
        The resolved case.
    attributes : dict
        Versions, ranks and options of the run.
    n_modes : int
        Number of modes, 0 without.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.reload()

    def reload(self) -> None:
        """List the data that the run has written since."""
        self.__dict__.pop("case", None)
        self._patiently(self._look)

    def _look(self, file: h5py.File) -> None:
        check_version(file, self.path)
        vtk = file["VTKHDF"]
        n = complete_snapshots(file)
        self.times: np.ndarray = file["snapshots/time"][:n]
        self.steps: np.ndarray = file["snapshots/step"][:n]
        self.n_nodes, self.n_bars = mesh_sizes(file)
        self.point_fields, self.cell_fields = field_names(vtk, "PointData"), field_names(vtk, "CellData")
        self.bar_data = constants(file)
        self.case_text: str = file["case/text"][()].decode()
        # a mesh of arrays makes a long text, which is not parsed without need
        staged = any(f"[[{key}]]" in self.case_text for key in ("stage", "load_case"))
        tables = tomllib.loads(self.case_text) if staged else {}
        derived = len(tables.get("load_case", ())) + len(tables.get("combination", ()))
        stages = tables.get("stage", [{"static": True}] if derived else [])
        self._static_stages = ["static" in stage for stage in stages] + [True] * derived
        self.attributes: dict[str, Any] = read_attributes(file["case"])
        self._n_rows = complete_rows(file)
        self._columns = dataset_names(file["history"])
        self._n_events = complete_rows(file, EVENT)
        if EVENT in file:
            self._columns += [f"{EVENT}/{name}" for name in dataset_names(file[EVENT])]
        self.n_modes = complete_modes(file)
        self._names = sorted(file[MODES]) if self.n_modes else []

    def summary(self) -> dict[str, str]:
        """Return what matters of the run, as texts by name: file, mesh, analysis, end, energies, largest forces."""
        history, case, n, times = self.history, self.case, self._n_rows, self.times
        rows = {"file": str(self.path), "mesh": f"{self.n_nodes:,} nodes, {self.n_bars:,} bars"}
        if len(times):
            rows["extent"] = " × ".join(engineering(float(size), "m") for size in np.ptp(self.positions(0), axis=0))
        rows["analysis"] = "; ".join((f"{one.name}: " if case.stage else "") + _analysis(one) for one in case.stages)
        rows["snapshots"] = f"{len(times)}: {self.axis.span(times[0], times[-1])}" if len(times) else "0"
        if not n:
            return rows | {"history": "0 rows"}
        time, last, steps = history["time"], int(history["step"][-1]), self.attributes.get("steps")
        rows["history"] = f"{n} rows: {self.axis.span(float(time[0]), float(time[-1]))}"
        rows["end"] = f"step {last:,}, {self.place(float(time[-1]))}"
        if self._static_stages:
            rows["end"] += f", stage {int(history['stage'][-1]) + 1} of {len(self._static_stages)}"
        elif steps is not None and self.axis is TIME:
            rows["end"] += ", which is the end of the run" if last >= steps else f", of {int(steps):,} steps"
        elif (end := case.end or 0.0) and self.axis is not TIME:  # a path has none
            done = float(time[-1]) >= end * (1.0 - 1e-9)
            rows["end"] += ", which is the end of the run" if done else f", of {end:g}"
        held = energies(history)
        for name, values in held.items():
            if np.any(values):
                three = (engineering(float(v), "J") for v in (values[0], values[np.abs(values).argmax()], values[-1]))
                rows[name.replace("_", " ")] = "{} at the start, largest {}, {} at the end".format(*three)
        if held:
            worst, largest = (float(np.abs(v).max()) for v in (balance_error(history), np.array([*held.values()])))
            rows["balance error"] = f"{engineering(worst, 'J')} ({worst / (largest or 1.0):.1e} of the largest energy)"
        for name in (name for name in history if re.fullmatch("wall/.*/force|support_force", name)):
            force, at, window = peak_force(self, name)
            if name != "support_force" or force > 0.0:
                over = f" (mean over {engineering(window, 's', 3)})" if window else ""
                rows[f"largest {name}"] = f"{engineering(force, 'N')}{over} at {self.place(at)}" if force else "none"
            wall = name.removeprefix("wall/").removesuffix("/force")
            touching, impulse = touch_impulse(self, wall) if force and name.startswith("wall/") else (0.0, 0.0)
            if impulse > 0.0:
                share = f"{engineering(touching, 'N s', 3)} of {engineering(impulse, 'N s', 3)}"
                rows[f"largest {name}"] += f"; impulse of first touches {share}"
        if np.any(broken := history.get("broken_bars", 0)):
            first = self.place(float(time[np.argmax(broken > 0)]))
            rows["broken bars"] = f"{int(broken[-1]):,} of {self.n_bars:,}, the first at {first}"
        return rows

    def __str__(self) -> str:
        return "\n".join([self._title, *aligned(self.summary().items())])

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self._title)}</p>{html_table(self.summary().items())}"

    @property
    def _title(self) -> str:
        return self.case.title or self.case.name

    def bar_table(self, i: int = -1) -> Table:
        """Return the bars at snapshot i (-1: the last) as a table: number, ends, section, material, area, groups, and
        all fields of bars."""
        ends = self.bars
        columns = {"bar": np.arange(self.n_bars), "node1": ends[:, 0], "node2": ends[:, 1]}
        names = sorted(self.bar_data, key=lambda name: (name.startswith("group:"), name == "area"))
        return Table(columns | {name: self.field(name, i) for name in (*names, *self.cell_fields)})

    @property
    def axis(self) -> Axis:
        """What its times are: time, load factor, or points of a path; with static stages, time and load factors."""
        axis = AXES[self.attributes.get("axis", TIME.symbol)]
        return axis._replace(staged=True) if any(self._static_stages) else axis

    @property
    def stretches(self) -> list[slice]:
        """The rows of the history that are of motion, those that follow each other together; none of static analyses.

        Only in these are times those of a clock, which spectra and filters need.
        """
        static = self._static_stages
        if not any(static):
            return [slice(0, self._n_rows)] if self.axis is TIME else []
        moving = np.concatenate([[False], ~np.array(static)[self.history["stage"]], [False]])
        ends = np.flatnonzero(np.diff(moving)).reshape(-1, 2)
        return [slice(first, end) for first, end in ends.tolist()]

    @property
    def stage_ends(self) -> np.ndarray:
        """The first time of the history, and the last one of each stage (stages + 1,)."""
        times, stages = self.history["time"], self.history["stage"]
        return np.unique([*times[:1], *times[:-1][np.diff(stages) > 0], *times[-1:]])

    def place(self, time: float) -> str:
        """Text of one of its times: ``t = 1.000 s``, in static analyses and stages ``load factor 0.25``."""
        static, history = self._static_stages, self.history
        if any(static) and self._n_rows:
            stage = int(stage_at(history, [time])[0])
            if static[stage]:
                rows = history["stage"] == stage
                text = LOAD_FACTOR.place(float(np.interp(time, history["time"][rows], history["load_factor"][rows])))
                return f"{self.case.stage[stage].name}, {text}" if sum(static) > 1 else text
        return self.axis.place(time)

    @property
    def history(self) -> History:
        """The history's columns: ``result.history["wall/floor/force"]``, (rows, 3).

        Those of events, ``event/...``, have a row for each event instead.
        """
        return History(self, self._columns, self._n_rows)

    @property
    def modes(self) -> Modes:
        """The modes of the state at the end of the run.

        Raises
        ------
        InputError
            When the file has none.
        """
        if not self.n_modes:
            raise InputError(f"{self.path}: has no modes: give the case a table [modes], and let it run to its end")
        return Modes(self, self._names)

    @cached_property
    def case(self) -> Case:
        """The case, read from the text in the file; what plugins or packages that are not there had is a warning."""
        from ..case.schema import Case

        folder = Path(self.attributes.get("folder", self.path.parent))
        return Case.from_toml(self.case_text, folder, source=str(self.path), lenient=True)

    @property
    def bars(self) -> np.ndarray:
        """Return the end nodes of each bar, (bars, 2) int64."""
        return self.read("VTKHDF/Connectivity", slice(None)).reshape(-1, 2)

    def positions(self, i: int) -> np.ndarray:
        """Return the positions at snapshot i (-1: the last), (nodes, 3) float64 [m]."""
        return self._snapshot("VTKHDF/Points", i, self.n_nodes)

    def field(self, name: str, i: int = -1) -> np.ndarray:
        """Return a field at snapshot i (-1: the last), (nodes, 3), (nodes,) or (bars,), in SI units.

        What bars have in all snapshots is a field too: the names of their ``section`` and ``material``, their ``area``
        [m2], and whether they are in ``group:NAME``.

        Raises
        ------
        InputError
            If the file has no such field.
        """
        if name in self.point_fields:
            return self._snapshot(f"VTKHDF/PointData/{name}", i, self.n_nodes)
        if name in self.cell_fields:
            return self._snapshot(f"VTKHDF/CellData/{name}", i, self.n_bars)
        if name in self.bar_data:
            values, names = self._patiently(lambda file: (file[BARS][name][:], file[BARS][name].attrs.get("names")))
            if name.startswith("group:"):
                return values.astype(bool)
            return values if names is None else names.astype(str)[values]
        known = self.point_fields + self.cell_fields + self.bar_data
        raise InputError(f"{self.path}: has no field {name!r}{nearest(name, known)}")

    def mesh(self, i: int) -> pyvista.UnstructuredGrid:
        """Return snapshot i (-1: the last) as a pyvista grid of lines with all its fields, as readers of VTK see them:
        ``section`` and ``material`` are numbers, whose names are in ``field_data["section_names"]``."""
        from ..formats.vtk import grid_of
        from ..mesh.whole import WholeMesh

        fields = {name: self.field(name, i) for name in self.cell_fields}
        fields |= {name: self.read(f"{BARS}/{name}", slice(None)) for name in self.bar_data}
        grid = grid_of(WholeMesh(self.positions(i), self.bars, bar_fields=fields))
        for name in self.point_fields:
            grid.point_data[name] = self.field(name, i)
        grid.field_data["TimeValue"] = [self.times[i]]
        for name in {"section", "material"} & {*self.bar_data}:
            names = self._patiently(lambda file, name=name: file[BARS][name].attrs["names"])
            grid.field_data[f"{name}_names"] = names.astype(str)
        return grid

    grid = mesh

    def table(self, names: Iterable[str] | None = None) -> Table:
        """Return columns of the history as a table, with the times.

        Vectors (rows, 3) become three columns, ``momentum.x``, ``momentum.y``, ``momentum.z``; those of nodes have the
        number of the node in the set before, ``probe/tip/position[0].x``.

        Parameters
        ----------
        names : of columns, of groups of them as ``wall/floor``, or expressions as of
            :func:`~pfem_petsc.output.table.select`; default: all but those of events

        Raises
        ------
        InputError
            If there is no such column.
        """
        known = [name for name in self._columns if not name.startswith(f"{EVENT}/")]
        chosen = [name for name in ("step", "time") if name in known]
        for name in known if names is None else names:
            found = [column for column in known if column == name or column.startswith(f"{name}/")]
            chosen += [column for column in found or [name] if column not in chosen]
        columns: dict[str, np.ndarray] = {}
        for name in chosen:
            found = select(self.history, name)
            columns |= flat_columns(name if found.single else f"({name})", found.values, found.vector)
        return Table(columns)

    def _snapshot(self, name: str, i: int, n_rows: int) -> np.ndarray:
        if not -len(self.times) <= i < len(self.times):
            raise IndexError(f"{self.path}: snapshot {i} of {len(self.times)}")
        first = (i % len(self.times)) * n_rows
        return self.read(name, slice(first, first + n_rows))

    def read(self, name: str, rows: slice) -> np.ndarray:
        """Return rows of a dataset, named by its path in the file."""
        return self._patiently(lambda file: file[name][rows])

    def column(self, name: str, n_rows: int) -> np.ndarray:
        """A column of the history, or of the events; names where numbers stand for them."""
        if not name.startswith(f"{EVENT}/"):
            return self.read(f"history/{name}", slice(0, n_rows))
        values = self.read(name, slice(0, self._n_events))
        names = h5py.check_enum_dtype(values.dtype)
        if names is None:
            return values
        words = {number: word for word, number in names.items()}
        return np.array([words[int(value)] for value in values], dtype=np.str_)

    def _patiently(self, look: Callable[[h5py.File], T]) -> T:
        with readable(self.path):
            for left in reversed(range(ATTEMPTS)):
                try:
                    with h5py.File(self.path, "r", locking=False) as file:
                        return look(file)
                except HDF5_ERRORS:
                    # Retrying does not help if no run is writing the file.
                    if not left or time.time() - self.path.stat().st_mtime > 60.0:
                        raise
                    time.sleep(PAUSE)
        raise AssertionError("unreachable")

    def __enter__(self) -> Result:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: no file is open."""

    def __repr__(self) -> str:
        return (
            f"<Result {self.path}: {len(self.times)} snapshots of {self.n_nodes} nodes and {self.n_bars} bars, "
            f"{self._n_rows} history rows>"
        )


def _analysis(stage: Any) -> str:
    if stage.time is not None:
        return f"{stage.time.integrator}, {stage.time.mass} mass, to {engineering(stage.time.end, 's')}"
    return f"static, {stage.static.method}" if stage.static is not None else "modes of the initial state"


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


def stage_at(history: Mapping[str, np.ndarray], times: Sequence[float]) -> np.ndarray:
    """Return the number of the stage (n,) of each of some times; the end of a stage belongs to it, not to the next."""
    if "stage" not in history:
        return np.zeros(len(times), dtype=int)
    stages = np.asarray(history["stage"])
    return stages[np.minimum(np.searchsorted(history["time"], times), len(stages) - 1)]


def energies(history: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the stored, lost and supplied energies (rows,) [J] of a history by name."""
    return {name: np.asarray(history[name], float) for name in (*STORED, *LOST, *SUPPLIED) if name in history}


def balance_error(history: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the imbalance of stored, lost and supplied energies since the first row, (rows,) [J]; None without."""
    held = energies(history)
    total = sum(-values if name in SUPPLIED else values for name, values in held.items())
    return total - total[0] if held else None


def impulse_of(history: Any, column: str) -> np.ndarray | None:
    """Return the impulse (rows, 3) [N s] of a column of forces, None where the result has none."""
    names = [f"{column.removesuffix('force')}{kind}" for kind in ("impulse", "jump_impulse")]
    if "load_factor" in history or names[0] not in history:
        return None
    return sum(np.asarray(history[name], dtype=float) for name in names if name in history)


def peak_force(result: Any, column: str) -> tuple[float, float, float]:
    """Return the largest mean force [N] of a column, the time [s] at which its window ends, and the window [s].

    The column is ``wall/NAME/force`` or ``support_force``. The window is the time of a wave forth and back in the
    shortest bar at the wall or the supports, or the interval of the rows if that is longer. The mean is the change of
    the impulse over it, zero before the run. Without an impulse, as in static analyses and old results, it is the
    largest force of a row, with a window of zero.
    """
    history = result.history
    time, force = history["time"], history[column]
    impulse = impulse_of(history, column)
    window = 2.0 * float(result.attributes.get(f"wave_time/{column}", 0.0))
    if impulse is None or not 0.0 < window < np.inf or len(time) < 2:
        size = np.linalg.norm(force, axis=1)
        peak = int(np.argmax(size))
        return float(size[peak]), float(time[peak]), 0.0
    window = max(window, float(np.diff(time).max()))
    # the mean of a piecewise linear impulse is largest where the window begins or ends at a row
    ends = np.unique(np.concatenate([time, np.minimum(time + window, time[-1])]))
    change = [np.interp(ends, time, part) - np.interp(ends - window, time, part, left=0.0) for part in impulse.T]
    mean = np.linalg.norm(change, axis=0) / window
    peak = int(np.argmax(mean))
    return float(mean[peak]), float(ends[peak]), window


def touch_impulse(result: Any, wall: str) -> tuple[float, float]:
    """Return the impulse [N s] of a wall in the rows in which nodes touch it, and that of all rows.

    Nodes touch in a row with more nodes in contact than the row before, and in the first row with an impulse. The row
    after each is counted too, as schemes correct the force there. As the interval of the rows falls, it converges to
    the impulse that stops nodes, which no mean force of a row shows.
    """
    history = result.history
    impulse = impulse_of(history, f"wall/{wall}/force")
    if impulse is None or len(impulse) < 2:
        return 0.0, 0.0
    changes = np.diff(impulse, axis=0)
    touching = np.diff(np.asarray(history[f"wall/{wall}/contacts"], dtype=float)) > 0.0
    touching[:1] |= changes[0].any()
    touching[1:] |= touching[:-1].copy()
    return float(np.linalg.norm(changes[touching].sum(axis=0))), float(np.linalg.norm(impulse[-1] - impulse[0]))
