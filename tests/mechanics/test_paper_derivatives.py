"""Forces and Hessian of a bar against the derivatives that the paper writes in terms of the squared length B."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss, open_result

YOUNG, AREA, EXPANSION, HEAT = 70e9, 3e-4, 2.4e-5, 60.0
YIELD = 70e6


def flying_bar():
    """A bar whose ends move apart fast enough to yield while it is hot."""
    truss = Truss(np.array([[0.2, 0.1, -0.3], [0.8, 0.9, 0.3]]), np.array([[0, 1]]))
    along = truss.points[1] - truss.points[0]
    return truss, Case(
        {
            "node_set": {"end": {"indices": [1]}},
            "material": {
                "it": {
                    "young_modulus": YOUNG,
                    "density": 2700.0,
                    "thermal_expansion": EXPANSION,
                    "yield_stress": YIELD,
                    "isotropic_hardening": 2e9,
                }
            },
            "section": {"it": {"area": AREA, "material": "it"}},
            "temperature": [{"value": HEAT}],
            "initial": {"on": [{"node_set": "end", "velocity": (60.0 * along).tolist()}]},
            "time": {"integrator": "central_differences", "step": 1e-5, "end": 2e-4},
        },
        mesh=truss,
    )


def paper(x, rest, strain):
    """Equations (4.8) and (4.10), in arrays of the six coordinates, for plastic and thermal strain together."""
    arm = x[1] - x[0]
    b = arm @ arm
    root = np.sqrt(b)
    first = 2.0 * np.concatenate([-arm, arm])
    second = 2.0 * np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(3))
    strain_i = first / (2.0 * rest * root)
    strain_ik = (second / root - np.outer(first, first) / (2.0 * root**3)) / (2.0 * rest)
    force = YOUNG * AREA / (2.0 * rest) * (1.0 - rest / root) * first
    hessian = rest * np.outer(first, first) / (2.0 * root**3) + (1.0 - rest / root) * second
    lost = rest * YOUNG * AREA * strain
    return force - lost * strain_i, YOUNG * AREA / (2.0 * rest) * hessian - lost * strain_ik


def test_forces_and_hessian_of_the_paper(tmp_path):
    truss, case = flying_bar()
    rest = np.linalg.norm(truss.points[1] - truss.points[0])
    with Simulation(case, output=tmp_path, quiet=True) as simulation:
        simulation.run()
        plastic = open_result(tmp_path).field("plastic_strain", -1)[0]
        assert plastic > 1e-3
        # elastic unloading, and a rotation
        x = simulation.state.x[:2].copy()
        x[1] = x[0] + 0.9999 * (x[1] - x[0])[[1, 2, 0]]
        force, hessian = paper(x, rest, plastic + EXPANSION * HEAT)
        position = simulation.position_vector()
        position.setArray(x.ravel())
        found = simulation.residual(position).getArray()
        dense = simulation.hessian(position).getValues(range(6), range(6))
    assert found == pytest.approx(force, rel=1e-9, abs=1e-9 * np.abs(force).max())
    assert dense == pytest.approx(hessian, rel=1e-9, abs=1e-9 * np.abs(hessian).max())


def test_temperature_is_an_additive_strain(tmp_path):
    """Ansys verification manual, VM27: a bar heated until it closes a gap, in inches and psi."""
    psi, inch = 6894.757293168, 0.0254
    case = Case(
        {
            "node_set": {"base": {"indices": [0]}, "end": {"indices": [1]}},
            "material": {"aluminium": {"young_modulus": 10.5e6 * psi, "density": 2700.0, "thermal_expansion": 12.5e-6}},
            "section": {"it": {"area": 1e-4, "material": "aluminium"}},
            "support": [{"node_set": "base", "fix": "xyz"}, {"node_set": "end", "fix": "yz"}],
            "temperature": [{"table": [[0.0, 0.0], [1.0, 100.0]]}],
            "wall": [{"name": "stop", "type": "plane", "point": [3.002 * inch, 0, 0], "normal": [-1.0, 0, 0]}],
            "static": {"step": 0.25},
        },
        mesh=Truss(np.array([[0.0, 0, 0], [3.0 * inch, 0, 0]]), np.array([[0, 1]])),
    )
    with Simulation(case, output=tmp_path, quiet=True) as simulation:
        simulation.run()
    stress = open_result(tmp_path).field("stress", -1)[0] / psi
    assert stress == pytest.approx(-6125.0, abs=1e-5)
