"""Orders of accuracy with damping by rates of strain, and of reactions, in every scheme."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import case_of

from pfem_petsc import Case

OMEGA, RATIO, SPEED, END = 1.0, 0.2, 0.1, 4.0
SCHEMES = {
    "chung_lee": {},
    "hulbert_chung": {},
    "souza_moura": {},
    "newmark": {"beta": 0.25, "gamma": 0.5},
    "houbolt": {},
    "wilson": {},
    "generalized_alpha": {},
    "energy_momentum": {},
    "central_differences": {},
}
NODES = {"root": [0], "tip": [1], "side": [2]}


def oscillator(scheme, kind, steps):
    """A bar of stiffness and free lumped mass 1, whose end starts at 0.1 m/s, damped in one of three ways."""
    material = {"young_modulus": OMEGA**2, "density": 2.0}
    material |= {"bars": {"stiffness_damping": 2 * RATIO / OMEGA}, "mass": {"damping": 4 * RATIO}}.get(kind, {})
    ends = {"root": {"group": "start"}, "tip": {"group": "end"}}
    dashpot = [{"between": ["root", "tip"], "coefficient": 2 * RATIO * OMEGA}]
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": ends,
        "material": {"m": material},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "support": [{"node_set": "root", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
        "initial": {"on": [{"node_set": "tip", "velocity": [SPEED, 0.0, 0.0]}]},
        "time": {"integrator": scheme, "step": END / steps, "end": END, **SCHEMES[scheme]},
        "output": {"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in ends]},
        "solver": {"rtol": 1e-13},
    }
    return Case.from_dict(data | ({"dashpot": dashpot} if kind == "dashpot" else {}))


def errors(scheme, kind, steps, folder):
    """Largest errors of position and reaction over amplitudes, against the closed form; the run's history."""
    history = run(oscillator(scheme, kind, steps), folder / f"{kind}{steps}")
    t, fast = history["time"], OMEGA * np.sqrt(1.0 - RATIO**2)
    decay, slow = SPEED * np.exp(-RATIO * OMEGA * t), RATIO * OMEGA / fast
    x, v = decay / fast * np.sin(fast * t), decay * (np.cos(fast * t) - slow * np.sin(fast * t))
    force = -(OMEGA**2) * x - (0.0 if kind == "mass" else 2.0 * RATIO * OMEGA * v)
    found = history["probe/tip/position"][:, 0, 0] - 1.0, history["probe/root/reaction"][:, 0, 0]
    assert history["support_force"][:, 0] == pytest.approx(found[1], abs=1e-15)
    return [np.abs(a - b).max() / SPEED for a, b in zip(found, (x, force))], history


@pytest.mark.slow
@pytest.mark.few_sets
@pytest.mark.parametrize("kind", ["bars", "dashpot"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_damped_oscillator(scheme, kind, tmp_path):
    """Second order, with the errors of damping by mass, which has the same equation; dissipation never decreases."""
    coarse, history = errors(scheme, kind, 40, tmp_path)
    fine, _ = errors(scheme, kind, 80, tmp_path)
    by_mass, _ = errors(scheme, "mass", 40, tmp_path)
    assert np.log2(np.divide(coarse, fine)) == pytest.approx(2.0, abs=0.12)
    # central differences have centred damping by mass, but extrapolate strain rates
    assert coarse[0] == pytest.approx(by_mass[0], rel=0.3 if scheme == "central_differences" else 1e-6)
    assert (np.diff(history["viscous_dissipation"]) >= 0.0).all()
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * history["kinetic_energy"][0]


def swing(folder, comm, scheme, steps, mass):
    """A damped bar and a dashpot on a moving support that swing in space, with a temperature and a load over time."""
    data = {
        "node_set": {name: {"indices": numbers} for name, numbers in NODES.items()},
        "material": {
            "m": {"young_modulus": 20.0, "density": 1.0, "stiffness_damping": 0.05, "thermal_expansion": 1e-3}
        },
        "section": {"s": {"area": 1.0, "material": "m"}},
        "support": [
            {"node_set": "root", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.3, 0.2, 0.0]]},
            {"node_set": "side", "fix": "xyz"},
        ],
        "dashpot": [{"between": ["side", "tip"], "coefficient": 0.5}],
        "temperature": [{"table": [[0.0, 0.0], [1.0, 20.0]]}],
        "load": [{"node_set": "tip", "force": [0.0, 1.0, 0.0], "table": [[0.0, 0.0], [1.0, 1.0]]}],
        "initial": {"on": [{"node_set": "tip", "velocity": [0.3, 2.0, 0.5]}]},
        "time": {"integrator": scheme, "step": 0.4 / steps, "end": 0.4, "mass": mass, **SCHEMES[scheme]},
        "output": {"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in NODES]},
        "solver": {"rtol": 1e-13, "guard": False},
    }
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.5, -0.5, 0.3]]
    return case_of(folder, comm, points, [[0, 1], [1, 2]], **data)


@pytest.mark.slow
@pytest.mark.few_sets
@pytest.mark.parallel
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_swing_on_a_moving_support(scheme, mass, comm, shared_tmp_path):
    """Differences between runs fall with the square of the step: positions, velocities, accelerations and reactions."""
    ends = []
    for steps in (20, 40, 80):
        history = run(swing(shared_tmp_path, comm, scheme, steps, mass), shared_tmp_path / str(steps), comm)
        tip = [history[f"probe/tip/{what}"][-1, 0] for what in ("position", "velocity", "acceleration")]
        ends.append([*tip, history["probe/root/reaction"][-1, 0], history["support_force"][-1]])
    first, second = np.linalg.norm(np.diff(ends, axis=0), axis=2)
    assert (np.log2(first / second) > 1.4).all(), np.log2(first / second)
