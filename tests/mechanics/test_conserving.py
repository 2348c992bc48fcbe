"""The force of a step in the energy-momentum scheme: its work on bars that yield."""

import numpy as np
import pytest
from helpers.twins import Law
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.mechanics.materials.elastoplastic import mean_correction
from pfem_petsc.stepping.model import Model

AREA, LENGTH = 2e-3, 0.5
HARDENINGS = [
    pytest.param({}, id="elastic"),
    pytest.param({"yield_stress": 90e6}, id="ideal"),
    pytest.param({"yield_stress": 90e6, "isotropic": 3e9, "kinematic": 5e9}, id="hardening"),
]
STRAINS = ("engineering", "green", "logarithmic")


def one_bar(law):
    return Model(
        Case.from_dict(
            {
                "mesh": {"generator": "rod", "length": LENGTH, "elements": 1},
                "material": {"it": law.case()},
                "section": {"it": {"area": AREA, "material": "it"}},
                "time": {"integrator": "energy_momentum", "step": 1e-5, "end": 1e-4},
            }
        ),
        MPI.COMM_SELF,
    )


@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("hardening", HARDENINGS)
def test_work_of_a_step_is_the_change_of_energies(strain, hardening):
    """There and back beyond the yield stress in large steps, in both directions and while the bar turns."""
    law = Law(70e9, strain=strain, **hardening)
    model = one_bar(law)
    x0 = model.mesh.points.copy()
    f = np.empty_like(x0)
    before = model.bars.forces(x0, f, commit=True)
    random = np.random.default_rng(4)
    stretches = [1.0 + s for s in (1e-3, 3e-3, 2e-3, -1e-3, -4e-3, -3.999e-3, 4e-3, 4e-3, 5e-3, 0.0)]
    stretches += list(1.0 + random.uniform(-5e-3, 5e-3, 30))
    scale = AREA * LENGTH * 70e9 * 5e-3**2
    yielded = 0
    for i, stretch in enumerate(stretches):
        x = np.zeros_like(x0)
        direction = np.array([np.cos(0.3 * i), np.sin(0.3 * i), 0.1])
        x[1] = LENGTH * stretch * direction / np.linalg.norm(direction)
        model.bars.step_forces(x0, x, f)
        work = (f * (x - x0)).sum()
        assert np.abs(f.sum(axis=0)).max() < 1e-9 * AREA * 70e9
        arm = 0.5 * (x[1] + x0[1]) - 0.5 * (x[0] + x0[0])
        assert np.abs(np.cross(arm, f[1])).max() < 1e-12 * AREA * 70e9  # no moment at the middle of the step
        after = model.bars.forces(x, np.empty_like(x0), commit=True)
        dissipated = after.of("plastic_heat") - before.of("plastic_heat")
        stored = after.total - before.total - dissipated
        assert dissipated >= -1e-15 * scale
        yielded += dissipated > 0.0
        assert abs(work - stored - dissipated) < 1e-12 * scale, (i, stretch)
        x0, before = x, after
    assert yielded > 10 or "yield_stress" not in hardening


def test_flow_in_bars_and_in_the_ledger_is_the_same():
    """The mean stress of a path by quadrature."""
    young, yield_stress, hard = 70e9, 90e6, 8e9
    parameters = (young, yield_stress, hard, 0.0, 1.0 / (young + hard))
    start, end = 0.4 * yield_stress / young, 3e-3
    strain = np.linspace(start, end, 200001)
    tangent = young * hard / (young + hard)
    at_yield = yield_stress / young
    stress = np.where(strain < at_yield, young * strain, yield_stress + tangent * (strain - at_yield))
    mean = 0.5 * (stress[1:] + stress[:-1]).mean()
    flow = np.array([(stress[-1] - yield_stress) / hard])
    change = np.array([stress[-1] - stress[0]])
    given = 0.5 * (stress[0] + stress[-1]) + mean_correction(
        parameters, change, np.zeros((2, 1)), np.array([flow, flow])
    )
    assert given == pytest.approx(mean, rel=1e-9)
    assert mean_correction(parameters, np.zeros(1), np.zeros((2, 1)), np.zeros((2, 1))) == 0.0
