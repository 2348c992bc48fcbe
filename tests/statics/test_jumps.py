"""Jumps of shallow trusses are told with their load and energy, smooth and cornered paths are not, and corners of yield
are passed."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from scipy.optimize import brentq

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import SimulationFailure

YOUNG, AREA = 2.1e11, 1e-3
JUMPS = "the truss jumps, which releases"


def arch(rise, force=1.0, static=None, **more):
    """Two bars of half span 1 m whose apex moves along z alone."""
    data = {
        "mesh": {"generator": "arrays", "points": [[-1, 0, 0], [0, 0, rise], [1, 0, 0]], "bars": [[0, 1], [1, 2]]},
        "node_set": {"feet": {"indices": [0, 2]}, "apex": {"indices": [1]}},
        "material": {"m": {"young_modulus": YOUNG, "density": 7850.0}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "apex", "fix": "xy"}],
        "load": [{"node_set": "apex", "force": [0.0, 0.0, -force]}],
        "static": static,
        "output": {"fields_every": 0},
        **more,
    }
    return Case.from_dict({key: value for key, value in data.items() if value is not None})


def limit(rise):
    """Height of the apex at the limit point, and the limit load, in closed form."""
    first = np.hypot(1.0, rise)
    return np.sqrt(first ** (2 / 3) - 1.0), 2 * YOUNG * AREA * (1 - first ** (-2 / 3)) ** 1.5


def released(rise):
    """Work of the limit load less the change of the strain energy, from the limit point to the height below at which it
    is carried."""
    first, (top, load) = np.hypot(1.0, rise), limit(rise)

    def force(z):
        return -2 * YOUNG * AREA * (np.hypot(1.0, z) / first - 1.0) * z / np.hypot(1.0, z)

    def energy(z):
        return YOUNG * AREA / first * (np.hypot(1.0, z) - first) ** 2

    low = brentq(lambda z: force(z) - load, -rise, -3 * rise)
    return load * (top - low) - (energy(low) - energy(top))


def told(case, folder, capfd, comm=MPI.COMM_SELF):
    """Warnings of a run, and the message of its failure. Collective."""
    failed = ""
    try:
        with Simulation(case, comm, output=folder, quiet=True) as simulation:
            simulation.run()
    except SimulationFailure as failure:
        failed = str(failure)
    comm.Barrier()
    return comm.bcast(capfd.readouterr().err), failed


@pytest.mark.parallel
@pytest.mark.parametrize("rise", [0.004, 0.1, 0.5])
@pytest.mark.parametrize("part", [1.2, 12.0])
def test_jump_is_told_with_its_load_and_energy(rise, part, comm, shared_tmp_path, capfd):
    """Of the closed form; the limit point lies in the interval of load factors, a 1024th of the increment or less."""
    _, load = limit(rise)
    case = arch(rise, part * load, {"step": 1.0}, solver={"guard": False})
    text, failed = told(case, shared_tmp_path / "out", capfd, comm)
    if failed:
        assert "limit point" in failed
        return
    assert text.count(JUMPS) == 1
    words = text.split("between load factors ")[1].split()
    low, high = float(words[0]), float(words[2])
    assert low <= 1.0 / part * (1 + 1e-9) and 1.0 / part <= high * (1 + 1e-9) and high - low < 1e-3
    assert float(text.split("releases ")[1].split()[0]) == pytest.approx(released(rise), rel=0.02)


@pytest.mark.parametrize("rise", [0.01, 0.1])
@pytest.mark.parametrize("part", [0.9, 0.999, 1.001, 3.0])
@pytest.mark.parametrize("step", [1.0, 0.3])
def test_no_load_beyond_the_limit_is_reached_without_a_word(rise, part, step, tmp_path, capfd):
    text, failed = told(arch(rise, part * limit(rise)[1], {"step": step}), tmp_path / "out", capfd)
    assert (JUMPS in text or "limit point" in failed) == (part > 1.0)


def test_paths_with_corners_and_strong_curvature_have_no_jump(tmp_path, capfd):
    """A rod across its axis, which stiffens from almost nothing, with one increment; and bars that yield one after the
    other, under a load that turns back."""
    rod = arch(-1e-3, 1e5, {"step": 1.0})
    text, failed = told(rod, tmp_path / "rod", capfd)
    assert JUMPS not in text and not failed
    plastic = {"m": {"young_modulus": YOUNG, "density": 7850.0, "yield_stress": 2e8, "isotropic_hardening": 1e9}}
    parallel = {"generator": "arrays", "bars": [[0, 3], [1, 3], [2, 3]]}
    parallel["points"] = [[0, 0, 1.0], [0.9, 0, 1.2], [-1.6, 0, 0.9], [0, 0, 0]]
    turn = [{"node_set": "tip", "force": [2e4, 0, -5e5], "table": [[0, 0], [0.5, 1], [1.0, -1]]}]
    case = {"mesh": parallel, "material": plastic, "load": turn}
    case["node_set"] = {"feet": {"indices": [0, 1, 2]}, "tip": {"indices": [3]}}
    case["support"] = [{"node_set": "feet", "fix": "xyz"}, {"node_set": "tip", "fix": "y"}]
    for step in (0.25, 0.1):
        text, failed = told(arch(0.1, static={"step": step}, **case), tmp_path / f"{step}", capfd)
        assert JUMPS not in text and not failed


@pytest.mark.slow
def test_a_stage_that_begins_out_of_equilibrium_is_no_jump(tmp_path, capfd):
    """A bar that hardens as a root of its plastic strain, stopped in flight and suddenly longer: no path is left."""
    law = {"law": "johnson_cook", "yield_stress": 1e3, "strength_coefficient": 1e4, "hardening_exponent": 0.5}
    data = {
        "mesh": {"generator": "arrays", "points": [[0.0, 0, 0], [1.0, 0, 0]], "bars": [[0, 1]]},
        "node_set": {"left": {"indices": [0]}, "all": {"all": True}},
        "material": {"m": {"young_modulus": 1e6, "density": 1e3, "rate_coefficient": 0.0, **law}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "left", "fix": "x"}, {"node_set": "all", "fix": "yz"}],
        "initial": {"velocity": [1.0, 0.0, 0.0]},
        "stage": [
            {"name": "flight", "time": {"integrator": "central_differences", "step": 2e-3, "end": 0.03}},
            {"name": "rest", "section": {"s": {"rest_length": 1.01}}, "static": {"step": 0.25}},
        ],
    }
    assert "jumps" not in told(Case.from_dict(data), tmp_path, capfd)


@pytest.mark.slow
def test_displacement_that_turns_back_is_no_jump_in_silence(tmp_path, capfd):
    """An arch pressed through a soft bar snaps back under the displacement of that bar's end."""
    rise = 0.2
    soft = {
        "mesh": {
            "generator": "arrays",
            "points": [[-1, 0, 0], [0, 0, rise], [1, 0, 0], [0, 0, 1.0 + rise]],
            "bars": [[0, 1], [1, 2], [1, 3]],
            "bar_groups": {"arch": [0, 1], "soft": [2]},
        },
        "node_set": {"feet": {"indices": [0, 2]}, "apex": {"indices": [1, 3]}, "end": {"indices": [3]}},
        "section": {
            "arch": {"bars": "arch", "area": AREA, "material": "m"},
            "soft": {"bars": "soft", "area": 1e-2 * AREA, "material": "m"},
        },
        "load": [{"node_set": "end", "force": [0.0, 0.0, -1e4]}],
    }
    keys = {"node_set": "end", "direction": [0.0, 0.0, -1.0], "displacement": 0.8}
    for step in (0.5, 20.0):
        static = {"method": "displacement", "step": step, "max_step": step, **keys}
        text, failed = told(arch(rise, static=static, solver={"guard": False}, **soft), tmp_path / f"{step}", capfd)
        assert "the displacement along static.direction turns back" in failed


def dome(**static):
    """Elastoplastic star dome, loaded at its apex [mm, N]: past the corner where its ring yields, spokes unload."""
    angles = np.pi / 3.0 * np.arange(6)
    inner = [[250 * np.cos(a), 250 * np.sin(a), 42.16] for a in angles]
    outer = [[500 * np.cos(a), 500 * np.sin(a), 0.0] for a in angles + np.pi / 6.0]
    ring = [[1 + k, 1 + (k + 1) % 6] for k in range(6)]
    legs = [[1 + k, 7 + j % 6] for k in range(6) for j in (k, k + 5)]
    return Case.from_dict(
        {
            "mesh": {
                "generator": "arrays",
                "points": [[0.0, 0.0, 72.16], *inner, *outer],
                "bars": [*([0, 1 + k] for k in range(6)), *ring, *legs],
            },
            "node_set": {"apex": {"indices": [0]}, "feet": {"indices": list(range(7, 13))}},
            "material": {
                "m": {
                    "law": "elastoplastic",
                    "young_modulus": 210e3,
                    "density": 1000.0,
                    "yield_stress": 123.6,
                    "isotropic_hardening": 529.5,
                }
            },
            "section": {"s": {"area": 1.0, "material": "m"}},
            "support": [{"node_set": "feet", "fix": "xyz"}],
            "load": [{"node_set": "apex", "force": [0.0, 0.0, -1.0]}],
            "static": {"node_set": "apex", "direction": [0.0, 0.0, -1.0], "displacement": 30.0, **static},
            "output": {"fields_every": 0},
        }
    )


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["displacement", "arc_length"])
def test_corner_of_yield_is_passed(method, comm, shared_tmp_path):
    """Beyond w = 27.95 one combination of loading and unloading bars is consistent, with dP/dw = -3.305."""
    case = dome(method=method, step=20.0, max_step=20.0)
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    if comm.rank == 0:
        load = open_result(shared_tmp_path / "out").history["load_factor"]
        assert load[-1] == pytest.approx(-2.0067, abs=2e-3)
