"""Damping proportional to stiffness: damping ratio by logarithmic decrement, energy, stable step, rigid motions."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

YOUNG, AREA, DENSITY, LENGTH = 1e6, 1e-2, 1000.0, 1.0
FREQUENCY = np.sqrt(YOUNG * AREA / LENGTH / (DENSITY * AREA * LENGTH / 2.0))
"""Of one bar with lumped mass, held at one end [rad/s]."""
EXPLICIT = ["chung_lee", "hulbert_chung", "souza_moura", "central_differences"]
IMPLICIT = ["newmark", "houbolt", "wilson", "generalized_alpha", "energy_momentum"]


def rod(ratio, integrator, step, end, material=(), elements=1, ends=("start",), **tables):
    """A rod along x with the damping ratio of its one-bar oscillator; its free end starts at 0.01 m/s."""
    time = {"integrator": integrator, "step": step, "end": end}
    if integrator == "newmark":
        time |= {"beta": 0.25, "gamma": 0.5}
    if integrator == "generalized_alpha":
        time["rho_inf"] = 1.0
    beta = 2.0 * ratio / FREQUENCY
    data = {
        "mesh": {"generator": "rod", "length": LENGTH, "elements": elements},
        "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY, "stiffness_damping": beta, **dict(material)}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "support": [{"node_set": "all", "fix": "yz"}, *({"node_set": end, "fix": "x"} for end in ends)],
        "initial": {"on": [{"node_set": "end", "velocity": [0.01, 0.0, 0.0]}]},
        "time": time,
        "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
    }
    return Case.from_dict(data | tables)


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("integrator", [*EXPLICIT[:3], "newmark", "generalized_alpha", "energy_momentum"])
@pytest.mark.parametrize("ratio", [0.02, 0.1])
def test_damping_ratio(integrator, ratio, tmp_path):
    """Logarithmic decrement of successive maxima: 2 pi xi/sqrt(1 - xi^2), with xi = beta omega/2."""
    step = 0.005 / FREQUENCY
    history = run(rod(ratio, integrator, step, 4000 * step), tmp_path)
    u = history["probe/end/position"][:, 0, 0] - LENGTH
    k = np.flatnonzero((u[1:-1] > u[:-2]) & (u[1:-1] >= u[2:])) + 1
    slope, curvature = 0.5 * (u[k + 1] - u[k - 1]), u[k + 1] - 2.0 * u[k] + u[k - 1]
    peaks = u[k] - 0.5 * slope**2 / curvature
    assert len(peaks) >= 3
    found = np.log(peaks[:-1] / peaks[1:]) / (2.0 * np.pi)
    # strains of 1e-3 are not linear
    assert found / np.sqrt(1.0 + found**2) == pytest.approx(ratio, rel=0.01)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", [*EXPLICIT, *IMPLICIT])
def test_energy_of_damped_bars(integrator, shared_tmp_path, comm):
    """The balance closes; what is dissipated grows, and is the energy that was there."""
    step = 0.02 / FREQUENCY
    history = run(rod(0.2, integrator, step, 800 * step, elements=3), shared_tmp_path)
    whole, lost = history["kinetic_energy"][0], history["viscous_dissipation"]
    assert (np.diff(lost) >= 0.0).all()
    assert lost[-1] + history["numerical_dissipation"][-1] == pytest.approx(whole, rel=0.01)
    assert np.abs(history["energy_imbalance"]).max() < 1e-8 * whole
    share = {"houbolt": 0.3, "wilson": 0.2, "chung_lee": 0.1, "souza_moura": 0.1, "hulbert_chung": 0.1}
    assert abs(history["numerical_dissipation"][-1]) < share.get(integrator, 0.05) * whole


@pytest.mark.parametrize("strain", ["engineering", "green", "logarithmic"])
@pytest.mark.parametrize("plastic", [False, True])
def test_energy_momentum_balances_to_rounding(strain, plastic, tmp_path):
    material = {"strain": strain}
    if plastic:
        material |= {"yield_stress": 3e3, "kinematic_hardening": 2e5, "isotropic_hardening": 1e5}
    step = 0.3 / FREQUENCY
    start = {"on": [{"node_set": "end", "velocity": [1.0, 0.0, 0.0]}]}
    case = rod(0.05, "energy_momentum", step, 60 * step, material, elements=3, solver={"rtol": 1e-13}, initial=start)
    history = run(case, tmp_path)
    whole = history["kinetic_energy"][0]
    assert history["viscous_dissipation"][-1] > 0.05 * whole
    assert (history["plastic_dissipation"][-1] > 0.01 * whole) == plastic
    assert np.abs(history["numerical_dissipation"]).max() < 1e-12 * whole
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * whole


@pytest.mark.parametrize("integrator", ["energy_momentum", "central_differences"])
def test_stressing_and_cooling_of_damped_bars(integrator, tmp_path):
    """Works of changing rest lengths and temperatures have the viscous stress in them."""
    step = 0.1 / FREQUENCY
    case = rod(
        0.1,
        integrator,
        step,
        100 * step,
        {"thermal_expansion": 1e-4},
        solver={"rtol": 1e-13},
        section={"s": {"area": AREA, "material": "m", "pretension": [[0.0, 0.0], [40 * step, 100.0]]}},
        temperature=[{"table": [[0.0, 0.0], [30 * step, -50.0]]}],
    )
    history = run(case, tmp_path)
    supplied = history["prestress_work"].max() + history["thermal_work"].max()
    assert history["viscous_dissipation"][-1] > 1e-3 * supplied > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * supplied
    exact = integrator == "energy_momentum"
    assert np.abs(history["numerical_dissipation"]).max() < (1e-11 if exact else 0.03) * supplied


@pytest.mark.parametrize("integrator", ["newmark", "central_differences"])
def test_rigid_rotation_is_not_damped(integrator, tmp_path):
    case = rod(
        0.5,
        integrator,
        0.05 / FREQUENCY,
        20.0 / FREQUENCY,
        initial={"angular_velocity": [0.0, 0.0, 1e-3 * FREQUENCY]},
        support=[],
    )
    history = run(case, tmp_path)
    assert history["viscous_dissipation"][-1] < 1e-5 * history["kinetic_energy"][0]
    assert history["kinetic_energy"][-1] == pytest.approx(history["kinetic_energy"][0], rel=1e-5)


def explicit_coefficients(rho):
    """a_m, beta, gamma of the explicit generalised-alpha method."""
    a = (2.0 * rho - 1.0) / (1.0 + rho)
    return a, (5.0 - 3.0 * rho) / ((1.0 + rho) ** 2 * (2.0 - rho)), 1.5 - a


COEFFICIENTS = {  # central differences have the limit of the method of Chung and Lee with beta = 1
    "central_differences": (0.0, 1.0, 1.5),
    "chung_lee": (0.0, 28.0 / 27.0, 1.5),
    "hulbert_chung": explicit_coefficients(0.8),
    "souza_moura": explicit_coefficients(0.3),
}


@pytest.mark.parametrize("integrator", EXPLICIT)
@pytest.mark.parametrize("ratio", [0.1, 1.0, 5.0])
def test_stable_step(integrator, ratio, tmp_path):
    """Stable at 0.98 of the limit, an eigenvalue -1: (2 b - g)/2 W^2 + xi (2 g - 1) W = 1 - 2 a; refused at 1.02."""
    a, b, g = COEFFICIENTS[integrator]
    bound = max(np.roots([0.5 * (2.0 * b - g), ratio * (2.0 * g - 1.0), 2.0 * a - 1.0]).real)
    with Simulation(rod(ratio, integrator, "auto", 1.0), output=tmp_path / "damped", quiet=True) as simulation:
        critical = simulation.plan.critical_step
    assert critical * FREQUENCY == pytest.approx(bound, rel=1e-3)
    step = 0.98 * critical
    history = run(rod(ratio, integrator, step, 300 * step), tmp_path / "below")
    assert np.abs(history["probe/end/position"][200:, 0, 0] - LENGTH).max() < 0.03 / FREQUENCY
    with pytest.raises(InputError, match="time.step = .* is above the limit"):
        Simulation(rod(ratio, integrator, 1.02 * critical, 1.0), output=tmp_path / "above", quiet=True)


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_and_statics(shared_tmp_path, comm):
    """Bitwise; a static stage before has neither rate nor viscous stress."""
    stages = [
        {"name": "pull", "static": {"step": 0.5}, "load": [{"node_set": "end", "force": [5.0, 0.0, 0.0]}]},
        {"name": "go", "load": [], "time": {"integrator": "newmark", "step": 0.05 / FREQUENCY}},
    ]
    stages[1]["time"]["end"] = 40 * stages[1]["time"]["step"]
    data = rod(0.1, "newmark", 1.0, 1.0, elements=2).to_dict()
    del data["time"], data["initial"]
    output = {"fields": ["viscous_stress", "stress"], "fields_every": 1}
    case = Case.from_dict(data | {"stage": stages, "output": data["output"] | output})
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 20)
    assert history["viscous_dissipation"][2] == 0.0 < history["viscous_dissipation"][-1]
    assert history["elastic_energy"][2] == pytest.approx(0.5 * 25.0 * LENGTH / (YOUNG * AREA), rel=1e-6)


LAWS = {
    "strut": {"law": "strut", "yield_stress": 1e5},
    "perzyna": {"law": "perzyna", "yield_stress": 5e2, "fluidity": 10.0},
    "softening": {"softening": [[0.0, 1.0, 1.0], [100.0, 0.5, 0.5]]},
}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("integrator", ["newmark", "central_differences"])
def test_with_other_laws(law, integrator, tmp_path):
    section = {"s": {"area": AREA, "material": "m", "shape": "round"}}
    step = 0.05 / FREQUENCY
    history = run(rod(0.1, integrator, step, 200 * step, LAWS[law], section=section), tmp_path)
    whole = history["kinetic_energy"][0]
    assert history["viscous_dissipation"][-1] > 0.2 * whole
    assert np.abs(history["energy_imbalance"]).max() < 1e-8 * whole
    assert abs(history["numerical_dissipation"][-1]) < 0.05 * whole
