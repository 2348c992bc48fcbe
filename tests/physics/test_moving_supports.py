"""Moving supports: a ground record against exact integration, no spurious oscillations, reactions, restarts."""

import numpy as np
import pytest
from helpers.oscillator import TIMES, ground, response
from helpers.runs import run

from pfem_petsc import Case

SECOND_ORDER = {
    "trapezoid": ("newmark", {"beta": 0.25, "gamma": 0.5}),
    "energy_momentum": ("energy_momentum", {}),
    "generalized_alpha": ("generalized_alpha", {}),
    "houbolt": ("houbolt", {}),
    "wilson": ("wilson", {}),
    "central_differences": ("central_differences", {}),
    "chung_lee": ("chung_lee", {}),
    "hulbert_chung": ("hulbert_chung", {}),
}
ALL = SECOND_ORDER | {"newmark": ("newmark", {})}
OMEGA = 4.0 * np.pi  # of the oscillator [rad/s]
STEP = 1e-3


def oscillator(scheme, support, end=0.75, damping=0.0, mass="lumped"):
    """One bar along x, whose free end has the circular frequency OMEGA relative to the base."""
    integrator, parameters = ALL[scheme]
    young = OMEGA**2 / (2.0 if mass == "lumped" else 3.0)
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"base": {"indices": [0]}, "mass": {"indices": [1]}, "all": {"all": True}},
            "material": {"m": {"young_modulus": young, "density": 1.0, "damping": damping}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "support": [{"node_set": "all", "fix": "yz"}, {"node_set": "base", "fix": "x", **support}],
            "time": {"integrator": integrator, "step": STEP, "end": end, "mass": mass, **parameters},
            "output": {
                "fields_every": 0,
                "probe": [{"name": "base", "node_set": "base"}, {"name": "mass", "node_set": "mass"}],
            },
            "solver": {"rtol": 1e-13},
        }
    )


def rows(values):
    return [[float(t), float(x), 0.0, 0.0] for t, x in zip(TIMES, values)]


def relative(history):
    return history["probe/mass/position"][:, 0, 0] - history["probe/base/position"][:, 0, 0] - 1.0


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize("scheme", SECOND_ORDER)
def test_acceleration_record_against_exact_integration(scheme, comm, shared_tmp_path):
    """Relative displacement to 1e-3 of its peak; the base has the record's acceleration, and its exact integrals."""
    values = ground(TIMES)[2]
    history = run(oscillator(scheme, {"acceleration": rows(values)}), shared_tmp_path)
    time = history["time"]
    exact = response(TIMES, values, time, OMEGA)
    assert np.abs(relative(history) - exact).max() <= 1e-3 * np.abs(exact).max()
    assert history["probe/base/acceleration"][:, 0, 0] == pytest.approx(np.interp(time, TIMES, values), abs=1e-9)
    # linear pieces between rows of a smooth function: integrals right to (omega 20 ms)^2/12
    assert history["probe/base/position"][:, 0, 0] == pytest.approx(ground(time)[0], abs=0.03 * 0.02)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["trapezoid", "central_differences", "hulbert_chung"])
def test_displacement_record(scheme, comm, shared_tmp_path):
    """Rows of displacements every 20 ms: the floor's acceleration is the ground's, not that of kinks at the rows."""
    x, _, a = ground(TIMES)
    history = run(oscillator(scheme, {"motion": rows(x)}), shared_tmp_path)
    time = history["time"]
    _, _, smooth = ground(time)
    floor = history["probe/base/acceleration"][:, 0, 0]
    assert np.abs(floor - smooth)[40:].max() < 0.02 * np.abs(smooth).max()
    exact = response(TIMES, a, time, OMEGA)
    # the record's own resolution: its accelerations by the spline differ by (omega 20 ms)^2/12 from the ground's
    assert np.abs(relative(history) - exact).max() < 0.03 * np.abs(exact).max()


RAMP = [[0.0, 0.0, 0.0, 0.0], [0.1, 0.02, 0.0, 0.0], [0.2, 0.02, 0.0, 0.0]]


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("interpolation", ["smooth", "linear"])
@pytest.mark.parametrize("scheme", ALL)
def test_nothing_rings_after_the_stop(scheme, interpolation, comm, shared_tmp_path):
    """A support that has stopped is at rest, exactly, and its reaction is the bar's force, which does not alternate."""
    support = {"motion": RAMP, "interpolation": interpolation}
    history = run(oscillator(scheme, support, end=0.3), shared_tmp_path)
    after = history["time"] > 0.2 + 2.5 * STEP
    assert (history["probe/base/velocity"][after] == 0.0).all()
    assert (history["probe/base/acceleration"][after] == 0.0).all()
    assert (history["probe/base/position"][after, 0, 0] == 0.02).all()
    reaction = history["probe/base/reaction"][after, 0, 0]
    jagged = np.abs(np.diff(reaction, 2)).max()
    assert jagged < 2.0 * (OMEGA * STEP) ** 2 * np.abs(reaction).max()


@pytest.mark.parallel
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", ALL)
def test_reactions_of_a_body_carried_along(scheme, mass, comm, shared_tmp_path):
    """All nodes prescribed: reactions are mass times acceleration (and damping times velocity), node by node."""
    values = ground(TIMES)[2]
    case = oscillator(scheme, {"acceleration": rows(values)}, end=0.2, damping=3.0, mass=mass).to_dict()
    case["support"][1]["node_set"] = "all"
    history = run(Case.from_dict(case), shared_tmp_path)
    time = history["time"][1:]
    expected = 1.0 * np.interp(time, TIMES, values)
    record = np.concatenate([[0.0], np.cumsum(0.01 * (values[1:] + values[:-1]))])
    row = np.clip(np.searchsorted(TIMES, time, "right") - 1, 0, len(TIMES) - 2)
    s = time - TIMES[row]
    speed = record[row] + s * values[row] + 0.5 * s * s * np.diff(values)[row] / 0.02
    total = history["support_force"][1:, 0]
    assert total == pytest.approx(expected + 3.0 * speed, abs=1e-9 * np.abs(values).max())
