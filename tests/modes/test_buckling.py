"""Linear buckling factors against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import ARCH_AREA, ARCH_YOUNG, LIMIT, arch_of, case_of, press

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.output.result import open_result


def buckled(case, folder, comm):
    """Factors, shapes and axial forces of a run, on all ranks. Collective."""
    assert Simulation(case, comm, output=folder, quiet=True).run() == 0
    found = None
    if comm.rank == 0:
        result = open_result(folder)
        assert result.modes.kind == "buckling"
        found = result.modes.load_factor, result.modes.shape, result.field("axial_force", -1)
    return comm.bcast(found)


def test_shallow_arch(shared_tmp_path, comm):
    """2 E A/l0 sin^2 = lambda 2 |N|/l0 cos^2: lambda |N| = E A tan^2, of the load that the linear theory gives."""
    case = arch_of(shared_tmp_path, comm, press(1e-6), modes={"kind": "buckling"})
    factor, shape, force = buckled(case, shared_tmp_path / "out", comm)
    assert factor * abs(force[0]) == pytest.approx(ARCH_YOUNG * ARCH_AREA * 0.1**2, rel=1e-12)
    sine = 0.1 / np.hypot(1.0, 0.1)
    assert factor * 1e-6 * LIMIT == pytest.approx(2.0 * ARCH_YOUNG * ARCH_AREA * 0.1**2 * sine, rel=1e-5)
    assert factor[0] * 1e-6 == pytest.approx(5.2, abs=0.03)  # times the limit load: docs/modes.md
    assert shape[0] == pytest.approx(np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 0]]), abs=1e-14)


BAYS, HEIGHT, ARM, LOAD = 6, 1.0, 2.0, 10.0
COLUMN, GUY, YOUNG = 1e-2, 1e-6, 1e11


def mast(folder, comm, **tables):
    """A column of bars along z whose nodes are held along x by guys; they are held along y. The top is pressed."""
    import h5py

    n = BAYS + 1
    column = np.stack([np.zeros(n), np.zeros(n), HEIGHT * np.arange(n)], axis=1)
    anchors = column[1:-1] + [ARM, 0.0, 0.0]
    bars = [[k, k + 1] for k in range(BAYS)], [[k, n + k - 1] for k in range(1, BAYS)]
    if comm.rank == 0:
        with h5py.File(folder / "mesh.h5", "w") as file:
            file["points"], file["bars"] = np.concatenate([column, anchors]), np.concatenate(bars)
            file["bar_groups/guys"] = np.arange(BAYS, 2 * BAYS - 1)
    comm.Barrier()
    return Case.from_dict(
        {
            "mesh": {"file": "mesh.h5"},
            "node_set": {
                "foot": {"indices": [0, *range(n, n + BAYS - 1)]},
                "top": {"indices": [BAYS]},
                "column": {"indices": list(range(1, BAYS))},
            },
            "material": {"steel": {"young_modulus": YOUNG, "density": 7800.0}},
            "section": {
                "column": {"area": COLUMN, "material": "steel"},
                "guy": {"bars": "guys", "area": GUY, "material": "steel"},
            },
            "support": [
                {"node_set": "foot", "fix": "xyz"},
                {"node_set": "top", "fix": "xy"},
                {"node_set": "column", "fix": "y"},
            ],
            "load": [{"node_set": "top", "force": [0.0, 0.0, -LOAD]}],
            "static": {"step": 1.0},
            "modes": {"kind": "buckling", "count": 4},
            **tables,
        },
        folder=folder,
    )


@pytest.mark.parallel
def test_guyed_column(shared_tmp_path, comm):
    """k x = lambda P/h (2 - 2 cos a) x with a = j pi/n: the sharpest zigzag buckles first."""
    factor, shape, force = buckled(mast(shared_tmp_path, comm), shared_tmp_path / "out", comm)
    assert force[:BAYS] == pytest.approx(np.full(BAYS, -LOAD), rel=1e-6)
    j = np.arange(BAYS - 1, BAYS - 5, -1)
    guy = YOUNG * GUY / ARM
    assert factor == pytest.approx(guy * HEIGHT / LOAD / (2.0 - 2.0 * np.cos(np.pi * j / BAYS)), rel=1e-5)
    sines = np.sin(np.pi * np.outer(j, np.arange(BAYS + 1)) / BAYS)
    for mode, sine in zip(shape[:, : BAYS + 1, 0], sines, strict=True):
        assert abs(mode @ sine) == pytest.approx(np.linalg.norm(mode) * np.linalg.norm(sine), rel=1e-9)
        assert mode.max() == pytest.approx(1.0, rel=1e-9)


def test_vibration_ceases_at_the_buckling_load(shared_tmp_path, comm):
    """At 99.9 % of the first factor the column is stable, at 100.1 % it is not."""
    guy = YOUNG * GUY / ARM
    critical = guy * HEIGHT / (2.0 - 2.0 * np.cos(np.pi * (BAYS - 1) / BAYS))
    for part, sign in ((0.999, 1.0), (1.001, -1.0)):
        load = [{"node_set": "top", "force": [0.0, 0.0, -part * critical]}]
        case = mast(shared_tmp_path, comm, load=load, modes={"count": 1})
        folder = shared_tmp_path / f"{part}"
        assert Simulation(case, comm, output=folder, quiet=True).run() == 0
        lowest = comm.bcast(open_result(folder).modes.frequency[0] if comm.rank == 0 else None)
        assert np.sign(lowest) == sign


@pytest.mark.parallel
@pytest.mark.parametrize("solver", ["dense", "scipy", "slepc"])
def test_what_has_no_factor_is_told(solver, shared_tmp_path, comm):
    if solver != "dense":
        pytest.importorskip({"slepc": "slepc4py"}.get(solver, solver))
    pulled = mast(
        shared_tmp_path,
        comm,
        load=[{"node_set": "top", "force": [0.0, 0.0, LOAD]}],
        modes={"kind": "buckling", "solver": solver},
    )
    with pytest.raises(SimulationFailure, match="put it in tension"):
        Simulation(pulled, comm, output=shared_tmp_path / "pulled", quiet=True).run()
    idle = mast(shared_tmp_path, comm, load=[], modes={"kind": "buckling", "solver": solver})
    with pytest.raises(SimulationFailure, match="there are none"):
        Simulation(idle, comm, output=shared_tmp_path / "idle", quiet=True).run()
    cable = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
            "node_set": {"start": {"group": "start"}, "end": {"group": "end"}},
            "material": {"steel": {"young_modulus": 2e11, "density": 7800.0, "thermal_expansion": 1e-5}},
            "section": {"cable": {"area": 1e-6, "material": "steel"}},
            "temperature": [{"value": 100.0}],
            "support": [{"node_set": end, "fix": "xyz"} for end in ("start", "end")],
            "modes": {"kind": "buckling", "solver": solver},
        }
    )
    with pytest.raises(SimulationFailure, match="mechanism"):
        Simulation(cable, comm, output=shared_tmp_path / "cable", quiet=True).run()


def test_the_first_bar_that_buckles_as_a_column_is_told(shared_tmp_path, comm):
    """Bars stay straight in the modes; log and formula agree on the column that buckles long before the truss."""
    points = np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.0], [0.0, 0.0, 2.0]])
    ends, area = np.array([[0, 3], [1, 3], [2, 3]]), 3e-4
    tables = {
        "material": {"steel": {"law": "strut", "yield_stress": 355e6, "young_modulus": 210e9, "density": 7850.0}},
        "section": {"legs": {"area": area, "material": "steel", "shape": "round", "effective_length": 0.7}},
        "node_set": {"feet": {"indices": [0, 1, 2]}, "top": {"indices": [3]}},
        "support": [{"node_set": "feet", "fix": "xyz"}],
        "load": [{"node_set": "top", "force": [0.0, 0.0, -1e3]}],
        "static": {"step": 1.0},
        "modes": {"kind": "buckling", "count": 1},
    }
    case = case_of(shared_tmp_path, comm, points, ends, **tables)
    factors, _, force = buckled(case, shared_tmp_path / "out", comm)
    lengths = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    columns = np.pi**2 * 210e9 * area**2 / (4.0 * np.pi) / (0.7 * lengths) ** 2 / -force
    text = (shared_tmp_path / "out" / "log.txt").read_text()
    assert columns.min() < factors[0]
    assert f"bar {columns.argmin()} is the first that buckles as a column, at the factor {columns.min():.6g}" in text
    assert "before the truss does" in text
