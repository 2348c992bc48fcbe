"""Elements of a third kind: chains that resist bending, written here in one class, beside bars and springs."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.solvers.matrix_free import BarProducts
from pfem_petsc.stepping.model import Model

STIFFNESS = 30.0  # N/m, of the second difference of positions
CHAIN = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 10},
    "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
    "section": {"it": {"area": 1e-4, "material": "it"}},
    "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-2},
}


class Bending:
    """Second differences of the positions of consecutive nodes (chains, 3): the energy k |a - 2 b + c|^2/2."""

    energies = ("spring_energy",)
    weights = np.array([1.0, -2.0, 1.0])

    def __init__(self, chains, stiffness):
        self.chains, self.stiffness = chains, stiffness

    def _add(self, vectors, factor, out):
        bent = np.einsum("j,mji->mi", self.weights, vectors[self.chains])
        np.add.at(out, self.chains, factor * self.stiffness * self.weights[:, None] * bent[:, None, :])
        return bent

    def add_forces(self, x, f, commit):
        return (0.5 * self.stiffness * float((self._add(x, 1.0, f) ** 2).sum()),)

    def add_step_forces(self, x0, x, f):
        self._add(0.5 * (x0 + x), 1.0, f)

    def add_product(self, weight, u, out):
        self._add(u, weight, out)


@pytest.fixture
def model():
    """A chain of bars that are also bent."""
    made = Model(Case.from_dict(CHAIN), MPI.COMM_SELF)
    nodes = made.mesh.points[:, 0].argsort()
    chains = np.column_stack([nodes[:-2], nodes[1:-1], nodes[2:]])
    made.bars.families.append(Bending(chains, STIFFNESS))
    return made


def test_forces_energies_and_products_belong_together(model):
    bars, random = model.bars, np.random.default_rng(3)
    x = model.mesh.points + random.uniform(-1e-2, 1e-2, model.mesh.points.shape)
    way = random.uniform(-1.0, 1.0, x.shape)
    f, forces, product = np.empty_like(x), [], np.empty_like(x)
    energies = []
    for s in (1e-6, -1e-6):
        energies.append(bars.forces(x + s * way, f, commit=False))
        forces.append(f.copy())
    BarProducts.tangent(bars, x).times(np.zeros(model.mesh.n_owned), way, product)
    for family in bars.families:
        family.add_product(1.0, way, product)
    np.testing.assert_allclose((forces[0] - forces[1]) / 2e-6, product, atol=1e-6 * np.abs(product).max())
    bars.forces(x, f, commit=False)
    assert energies[0].of("spring_energy") > 0.0
    change = (energies[0].total - energies[1].total) / 2e-6
    assert change == pytest.approx(float((f * way).sum()), rel=1e-6)


def test_work_of_a_step_is_the_change_of_energy(model):
    bars, random = model.bars, np.random.default_rng(4)
    x0, x = (model.mesh.points + random.uniform(-1e-2, 1e-2, model.mesh.points.shape) for _ in range(2))
    f = np.empty_like(x)
    before, after = (bars.forces(at, f, commit=False).total for at in (x0, x))
    bars.step_forces(x0, x, f)
    assert float((f * (x - x0)).sum()) == pytest.approx(after - before, rel=1e-12)


def test_batches_leave_models_with_other_elements_to_single_steps(model):
    assert not model.steady
