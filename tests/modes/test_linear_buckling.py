"""Buckling factors of linear forces: of changes from the start of an analysis, whatever the size of the load."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import ARCH_AREA, ARCH_YOUNG, LIMIT, arch_of

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import open_result

MODES = {"kind": "buckling", "count": 1, "linear": True}
STIFFNESS, HALF, YOUNG, AREA, DENSITY, EXPANSION = 1e4, 0.5, 1e9, 1e-4, 1000.0, 1e-5
DIFFERS = "differ from those of a linear solve"


def factors(case, folder, comm):
    """Factors of a run, and its log, on all ranks. Collective."""
    assert Simulation(case, comm, output=folder, quiet=True).run() == 0
    found = None
    if comm.rank == 0:
        found = open_result(folder).modes.load_factor, (folder / "log.txt").read_text()
    return comm.bcast(found)


def column(**tables):
    """Two bars of 0.5 m along z whose joint a spring to the ground holds along x: (|N1| + |N2|)/l = k."""
    data = {
        "mesh": {
            "generator": "arrays",
            "points": [[0, 0, 0], [0, 0, HALF], [0, 0, 2 * HALF]],
            "bars": [[0, 1], [1, 2]],
        },
        "node_set": {"foot": {"indices": [0]}, "joint": {"indices": [1]}, "top": {"indices": [2]}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY, "thermal_expansion": EXPANSION}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "support": [
            {"node_set": "foot", "fix": "xyz"},
            {"node_set": "joint", "fix": "y"},
            {"node_set": "top", "fix": "xy"},
        ],
        "spring": [{"node_set": "joint", "stiffness": [STIFFNESS, 0.0, 0.0]}],
        "modes": MODES,
        **tables,
    }
    return Case.from_dict(data)


SUM = STIFFNESS * HALF  # of both axial forces, at which it buckles


def held(table=None):
    top = {"node_set": "top", "fix": "xyz"}
    supports = [{"node_set": "foot", "fix": "xyz"}, {"node_set": "joint", "fix": "y"}]
    return [*supports, top | ({} if table is None else {"motion": table})]


@pytest.mark.parametrize("part", [1e-5, 0.9, 50.0])
@pytest.mark.parametrize("static", [False, True])
def test_arch_under_any_load(part, static, shared_tmp_path, comm):
    """lambda P = 2 E A tan^2 a sin a, without an analysis and beside one that the load does not make linear."""
    if static and part > 1.0:
        pytest.skip("the analysis would not reach its end")
    load = {"load": [{"node_set": "apex", "force": [0.0, 0.0, -part * LIMIT]}]}
    case = arch_of(shared_tmp_path, comm, load, modes=MODES, **({"static": {"step": 0.25}} if static else {}))
    found, log = factors(case, shared_tmp_path / "out", comm)
    exact = 2.0 * ARCH_YOUNG * ARCH_AREA * 0.1**2 * 0.1 / np.hypot(1.0, 0.1)
    assert found[0] * part * LIMIT == pytest.approx(exact, rel=1e-10)
    assert DIFFERS not in log


@pytest.mark.parametrize(("part", "warned"), [(1e-4, False), (0.5, True)])
def test_state_that_is_not_linear_is_told(part, warned, shared_tmp_path, comm):
    load = {"load": [{"node_set": "apex", "force": [0.0, 0.0, -part * LIMIT]}], "static": {"step": 0.25}}
    case = arch_of(shared_tmp_path, comm, load, modes={"kind": "buckling"})
    _, log = factors(case, shared_tmp_path / "out", comm)
    assert (DIFFERS in log) == warned


@pytest.mark.parametrize("linear", ["auto", "gamg"])
def test_load_beyond_one_that_acts_at_the_start(linear, shared_tmp_path, comm):
    """The base is the state at load factor 0: 2 (a + lambda (b - a)) = k l."""
    a, b, operator = 500.0, 700.0, "auto" if linear == "auto" else "matrix_free"
    load = {"node_set": "top", "force": [0.0, 0.0, -1.0], "table": [[0.0, a], [1.0, b]]}
    case = column(load=[load], static={"step": 1.0}, solver={"linear": linear, "operator": operator})
    found, _ = factors(case, shared_tmp_path / "out", comm)
    assert found[0] == pytest.approx((0.5 * SUM - a) / (b - a), rel=1e-9)


@pytest.mark.parallel
def test_load_beyond_a_preload(shared_tmp_path, comm):
    """The last stage begins with the preload a and bars shorter by a/EA: 2 (a + lambda (b - a)) = k l."""
    a, b = 500.0, 700.0
    presses = [{"load": [{"node_set": "top", "force": [0.0, 0.0, -force]}]} for force in (a, b)]
    stages = [{"name": f"{k}", "static": {"step": 1.0}, **press} for k, press in enumerate(presses)]
    found, _ = factors(column(stage=stages), shared_tmp_path / "out", comm)
    shorter = 1.0 - a / (YOUNG * AREA)
    assert found[0] == pytest.approx((0.5 * SUM * shorter - a) / (b - a), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parallel
def test_gravity_heat_and_prescribed_motion(shared_tmp_path, comm):
    """Each of them as the load; the first bar carries both masses, a clamped column E A (alpha T or d/L)."""
    mass, g = DENSITY * AREA * HALF, 9.81
    found, _ = factors(column(gravity={"acceleration": [0.0, 0.0, -g]}), shared_tmp_path / "gravity", comm)
    assert found[0] == pytest.approx(SUM / ((0.5 * mass + 1.5 * mass) * g), rel=1e-9)
    for k, analysis in enumerate(({"static": {"step": 1.0}}, {})):  # without one, up to load factor 1
        heat = {"temperature": [{"table": [[0.0, 0.0], [1.0, 20.0]]}], "support": held()}
        found, _ = factors(column(**heat, **analysis), shared_tmp_path / f"heat{k}", comm)
        assert found[0] == pytest.approx(0.5 * SUM / (YOUNG * AREA * EXPANSION * 20.0), rel=1e-9)
        move = {"support": held([[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1e-3]])}
        found, _ = factors(column(**move, **analysis), shared_tmp_path / f"move{k}", comm)
        assert found[0] == pytest.approx(0.5 * SUM / (YOUNG * AREA * 1e-3 / (2 * HALF)), rel=1e-9)


def test_what_has_no_linear_forces_is_refused(comm):
    with pytest.raises(InputError, match="buckling"):
        column(modes={"linear": True})
    motion = column(time={"integrator": "newmark", "step": 1e-4, "end": 1e-3})
    with pytest.raises(InputError, match="not those of a linear solve"):
        Simulation(motion, comm, check_only=True)
