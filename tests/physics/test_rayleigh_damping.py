"""Damping by ratios of critical damping, and supports that move by records of velocity, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError

STIFFNESS = 1e4


def oscillators(masses, step, end, mass_of_bars=1e-6, **more):
    """Masses on bars of the same stiffness [N/m] along x, with the bars apart from each other."""
    count = len(masses)
    points = [[0.0, float(k), 0.0] for k in range(count)] + [[1.0, float(k), 0.0] for k in range(count)]
    sets = {f"m{k}": {"indices": [count + k]} for k in range(count)}
    return {
        "mesh": Truss(points, [(k, count + k) for k in range(count)]),
        "material": {"m": {"young_modulus": STIFFNESS / 1e-4, "density": mass_of_bars / 1e-4}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "node_set": {
            "base": {"indices": list(range(count))},
            "free": {"indices": list(range(count, 2 * count))},
            **sets,
        },
        "support": [{"node_set": "base", "fix": "xyz"}, {"node_set": "free", "fix": "yz"}],
        "mass": [{"node_set": f"m{k}", "value": mass} for k, mass in enumerate(masses)],
        "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": step, "end": end},
        "output": {"probe": [{"name": f"m{k}", "node_set": f"m{k}"} for k in range(count)]},
        **more,
    }


def run(data, folder):
    with Simulation(Case.from_dict(data, name="damped"), MPI.COMM_SELF, output=folder, quiet=True) as simulation:
        simulation.run()
    return open_result(folder).history


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["newmark", "central_differences"])
def test_ratios_of_three_oscillators(integrator, tmp_path):
    """At both frequencies the ratio is the given one, between them it is smaller; nodal masses are damped too."""
    masses, ratio = np.array([4.0, 2.0, 1.0]), 0.03
    omega = np.sqrt(STIFFNESS / masses)
    damping = {"ratio": ratio, "frequencies": [omega[0] / (2.0 * np.pi), omega[2] / (2.0 * np.pi)]}
    start = {"initial": {"velocity": [0.01, 0.0, 0.0]}}
    data = oscillators(masses, 2e-4, 0.6, mass_of_bars=1e-3, damping=damping, **start)
    if integrator != "newmark":
        data["time"] = {"integrator": integrator, "step": 2e-5, "end": 0.6}
    history = run(data, tmp_path / "out")
    a, b = 2.0 * ratio * omega[0] * omega[2] / (omega[0] + omega[2]), 2.0 * ratio / (omega[0] + omega[2])
    expected = 0.5 * (a / omega + b * omega)
    assert expected[[0, 2]] == pytest.approx([ratio, ratio], rel=1e-12)
    for k, (w, z) in enumerate(zip(omega, expected, strict=True)):
        x, t = history[f"probe/m{k}/position"][:, 0, 0] - 1.0, history["time"]
        damped = w * np.sqrt(1.0 - z * z)
        exact = 0.01 / damped * np.exp(-z * w * t) * np.sin(damped * t)
        np.testing.assert_allclose(x, exact, atol=0.01 * np.abs(exact).max())
        late = t > 0.45
        assert np.abs(x[late]).max() == pytest.approx(np.abs(exact[late]).max(), rel=2e-3)


def test_of_one_frequency_the_ratio_is_smallest_there():
    data = oscillators([1.0], 1e-3, 1e-2, damping={"ratio": 0.02, "frequencies": [5.0]})
    case = Case.from_dict(data)
    a, b = case.point_mass[0].damping, case.material["m"].stiffness_damping
    assert case.material["m"].damping == pytest.approx(a * case.material["m"].density)
    w = 10.0 * np.pi * np.array([0.8, 1.0, 1.25])
    z = 0.5 * (a / w + b * w)
    assert z[1] == pytest.approx(0.02)
    assert z[0] == pytest.approx(z[2])
    assert z[0] > z[1]
    assert Case.from_toml(case.to_toml()) == case


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"damping": {"ratio": 1.2, "frequencies": [1.0]}}, r"damping.ratio = 1.2: .* < 1"),
        ({"damping": {"ratio": 0.02}}, "damping.frequencies: this key is missing"),
        ({"damping": {"ratio": 0.02, "frequencies": [1.0, 2.0, 3.0]}}, "damping.frequencies"),
        (
            {
                "damping": {"ratio": 0.02, "frequencies": [1.0]},
                "material": {"m": {"young_modulus": 1e8, "density": 10.0, "damping": 3.0}},
            },
            r"material.m.damping = 3.0: \[damping\] gives each material its damping",
        ),
    ],
)
def test_refused(change, text):
    with pytest.raises(InputError, match=text):
        Case.from_dict(oscillators([1.0], 1e-3, 1e-2) | change)


def test_record_of_velocity(tmp_path):
    """A base with a velocity by rows moves as its integral says: exact at every step."""
    rows = [[0.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.0, 0.0], [0.3, -0.1, 0.0, 0.0], [0.4, 0.0, 0.0, 0.0]]
    data = oscillators([1.0], 5e-3, 0.5)
    data["support"][0]["velocity"] = rows
    data["output"]["probe"] = [{"name": "base", "node_set": "base"}]
    history = run(data, tmp_path / "out")
    times, values = np.array(rows)[:, 0], np.array(rows)[:, 1]
    t = history["time"]
    fine = np.linspace(0.0, 0.5, 500001)
    speed = np.interp(fine, times, values, right=0.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(fine) * (speed[1:] + speed[:-1]))])
    np.testing.assert_allclose(history["probe/base/position"][:, 0, 0], np.interp(t, fine, way), atol=1e-9)
    velocity = history["probe/base/velocity"][:, 0, 0]
    np.testing.assert_allclose(velocity, np.interp(t, times, values, right=0.0), atol=1e-12)
    case = Case.from_dict(data)
    assert Case.from_toml(case.to_toml()) == case
    (tmp_path / "record.csv").write_text("t,vx,vy,vz\n" + "\n".join(",".join(map(str, row)) for row in rows))
    data["support"][0] = {"node_set": "base", "fix": "xyz", "velocity_file": "record.csv"}
    assert Case.from_dict(data, folder=tmp_path).support[0].velocity == case.support[0].velocity
    data["support"][0]["velocity"] = rows
    with pytest.raises(InputError, match="expected at most one of the keys velocity_file"):
        Case.from_dict(data, folder=tmp_path)
