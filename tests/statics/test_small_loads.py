"""Loads smaller than the force that rounding of positions leaves in the stiffest bars."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result

AREA = 1e-4


def rod(moduli, force, node=-1, points=None, **tables):
    """A rod along x of bars with the given moduli, held at its start, with a force along x at a node."""
    count = len(moduli)
    points = np.arange(count + 1.0) if points is None else np.array(points)
    materials = {f"m{k}": {"young_modulus": modulus, "density": 1000.0} for k, modulus in enumerate(moduli)}
    given = {
        "mesh": {
            "generator": "arrays",
            "points": np.outer(points, [1.0, 0.0, 0.0]).tolist(),
            "bars": [[k, k + 1] for k in range(count)],
            "bar_groups": {f"g{k}": [k] for k in range(count)},
        },
        "node_set": {"all": {"all": True}, "base": {"indices": [0]}, "loaded": {"indices": [node % (count + 1)]}},
        "material": materials,
        "section": {f"s{k}": {"bars": f"g{k}", "area": AREA, "material": f"m{k}"} for k in range(count)},
        "support": [{"node_set": "all", "fix": "yz"}, {"node_set": "base", "fix": "x"}],
        "load": [{"node_set": "loaded", "force": [force, 0.0, 0.0]}],
        "static": {"step": 1.0},
        "output": {"probe": [{"name": "loaded", "node_set": "loaded"}]},
    } | tables
    return Case.from_dict({key: value for key, value in given.items() if value is not None}, source="rod.toml")


def displacements(case, comm, folder):
    """Displacement of the loaded node along x, in each row of the history."""
    with Simulation(case, comm, output=folder / "out", quiet=True) as simulation:
        simulation.run()
    x = open_result(folder / "out" / "result.vtkhdf").history["probe/loaded/position"][:, 0, 0]
    return x - x[0]


@pytest.mark.parallel
@pytest.mark.parametrize("ratio", [1e8, 1e10, 1e12])
@pytest.mark.parametrize(
    "static",
    [
        {"method": "newton", "step": 1.0},
        {"method": "relaxation", "step": 1.0},
        {"method": "arc_length", "step": 1.0, "end": 1.0},
    ],
    ids=lambda static: static["method"],
)
def test_a_soft_bar_on_a_stiff_one_carries_its_load(comm, shared_tmp_path, static, ratio):
    """F L/EA of the soft bar, where the stiff one has a rounding of its force larger than F."""
    case = rod([2e6 * ratio, 2e6], 0.04, static=static)
    expected = 0.04 / (2e6 * AREA) * (1.0 + 1.0 / ratio)
    assert displacements(case, comm, shared_tmp_path)[-1] == pytest.approx(expected, rel=1e-9, abs=0.0)


@pytest.mark.parallel
def test_a_load_far_below_the_forces_of_a_prestress_moves_the_truss(comm, shared_tmp_path):
    """1e-7 N between two bars with 1 kN: F/(2 EA/L), of which the tolerance relative to 1 kN knows nothing."""
    case = rod(
        [2e11, 2e11],
        1e-7,
        node=1,
        points=[-1.0, 0.0, 1.0],
        support=[
            {"node_set": "all", "fix": "yz"},
            {"node_set": "base", "fix": "x"},
            {"node_set": "tip", "fix": "x"},
        ],
        node_set={
            "all": {"all": True},
            "base": {"indices": [0]},
            "loaded": {"indices": [1]},
            "tip": {"indices": [2]},
        },
        section={f"s{k}": {"bars": f"g{k}", "area": AREA, "material": f"m{k}", "pretension": 1e3} for k in range(2)},
    )
    assert displacements(case, comm, shared_tmp_path)[-1] == pytest.approx(1e-7 / 4e7, rel=5e-2, abs=0.0)


@pytest.mark.parametrize("method", ["newton", "relaxation"])
def test_forces_that_rounding_hides_are_told(comm, shared_tmp_path, capsys, method):
    """1e-8 N on steel: 5e-16 m, two roundings of the coordinate; 1 N is resolved, and nothing is told."""
    static = {"method": method, "step": 1.0}
    u = displacements(rod([2e11], 1e-8, static=static), comm, shared_tmp_path)[-1]
    assert u == pytest.approx(5e-16, abs=2.3e-16)
    assert "forces of 1e-08 N are balanced to" in capsys.readouterr().err
    u = displacements(rod([2e11], 1.0, static=static), comm, shared_tmp_path)[-1]
    assert u == pytest.approx(5e-8, rel=1e-8, abs=0.0)
    assert "balanced" not in capsys.readouterr().err


@pytest.mark.parallel
def test_a_self_stress_without_loads_is_no_small_force(comm, shared_tmp_path, capsys):
    """Bars of 1 kN that balance each other leave only rounding at the nodes."""
    steel = {"bars": "g0", "area": AREA, "material": "m0", "pretension": 1e3}
    case = rod([2e11, 2e11], 0.0, node=2, section={"s0": steel, "s1": steel | {"bars": "g1"}})
    displacements(case, comm, shared_tmp_path)
    assert "balanced" not in capsys.readouterr().err


@pytest.mark.parallel
def test_an_implicit_step_moves_a_soft_bar_beside_a_stiff_one(comm, shared_tmp_path):
    """The trapezoidal rule of a mass on a spring; the stiff bar between the spring and the support does not move."""
    h, stiffness, mass, force = 0.002, 2e6 * AREA, 0.05, 0.04
    times = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": h, "end": 20 * h}
    case = rod([2e18, 2e6], force, static=None, time=times)
    u, v, a = 0.0, 0.0, force / mass
    expected = [u]
    for _ in range(20):
        known = u + h * v + 0.25 * h**2 * a
        after = (force - stiffness * known) / (mass + 0.25 * h**2 * stiffness)
        u, v, a = known + 0.25 * h**2 * after, v + 0.5 * h * (a + after), after
        expected.append(u)
    np.testing.assert_allclose(displacements(case, comm, shared_tmp_path), expected, rtol=1e-6, atol=1e-14)
