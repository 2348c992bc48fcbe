"""Records of arrays that compiled loops take by reference, and the phases of a step beside formulas."""

from types import SimpleNamespace

import numpy as np
import pytest

from pfem_petsc.stepping.phases import (
    CONTACT,
    DAMPING,
    EXTERNAL,
    INERTIAL,
    INTERNAL,
    KINETIC,
    Motion,
    Nodes,
    Prescribed,
    accumulate,
    accumulate_loads,
    apply_supports,
    balancing,
    new_sums,
    react,
    work_of_contact,
)

RNG = np.random.default_rng(5)
N, H = 7, 1e-2


def motion():
    return Motion(H, *RNG.normal(size=(4, 3, N)), np.zeros((N, 3)))


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("loaded", [False, True])
def test_a_balance_with_supports_and_contact_has_the_works_of_its_forces(damped, loaded):
    """Increments, velocities, reactions and works are those of m a + c v = f_ext - f_int + r with central differences,
    computed here node by node."""
    mass, damping = RNG.uniform(1.0, 2.0, N), RNG.uniform(1.0, 5.0, N) if damped else np.empty(0)
    external = RNG.normal(size=(3, N)) if loaded else np.empty((3, 0))
    stiffness = mass / H**2 + (damping / (2.0 * H) if damped else 0.0)
    nodes, here, sums = Nodes(mass, damping, stiffness, 1.0 / stiffness, external), motion(), new_sums()
    at, components = np.array([1, 1, 4]), np.array([0, 2, 1])
    x, before = here.x.copy(), here.half.copy()
    held = Prescribed(at, components, x[components, at] + 1e-3, *np.zeros((3, 3)), np.zeros((N, 3)))
    s = SimpleNamespace(nodes=nodes, motion=here, held=held, sums=sums)
    for phase in (balancing(loaded, damped), apply_supports, react):
        getattr(phase, "py_func", phase)(s, 0)
    after = here.half
    v, a = 0.5 * (before + after), (after - before) / H
    force = (external if loaded else 0.0) - here.f - (damping * v if damped else 0.0)
    reaction = mass * a - force
    fixed = np.zeros((3, N), dtype=bool)
    fixed[components, at] = True
    np.testing.assert_allclose(reaction[~fixed], 0.0, atol=1e-9)
    np.testing.assert_allclose(held.reaction.T[fixed], reaction[fixed], rtol=1e-9)
    np.testing.assert_allclose((x + H * after)[fixed], x[fixed] + 1e-3, rtol=1e-12)
    np.testing.assert_allclose(sums.works[INTERNAL], H * (here.f * v).sum(), rtol=1e-10)
    np.testing.assert_allclose(sums.works[EXTERNAL], H * (external * v).sum() if loaded else 0.0, rtol=1e-10)
    np.testing.assert_allclose(sums.works[DAMPING], H * (damping * v * v).sum() if damped else 0.0, rtol=1e-10)
    drag = -(damping * v).sum(axis=1) if damped else np.zeros(3)
    loads = external.sum(axis=1) if loaded else np.zeros(3)
    np.testing.assert_allclose(sums.forces, [held.reaction.sum(axis=0), loads, drag], rtol=1e-9, atol=1e-12)
    u = H * (after - before)
    np.testing.assert_allclose(here.u, u, rtol=1e-9, atol=1e-12)
    touched = np.array([0, 3])
    here.contact[touched] = RNG.normal(size=(2, 3))
    work_of_contact(touched, here, sums)
    accumulate(nodes, here, touched, sums)
    getattr(accumulate_loads, "py_func", accumulate_loads)(s, 0)
    push, left = here.contact.T, 0.5 * H * before
    np.testing.assert_allclose(sums.works[CONTACT], H * (push * v).sum(), rtol=1e-10)
    ends = sums.ends
    np.testing.assert_allclose(ends[INTERNAL], (here.f * left).sum(), rtol=1e-9)
    np.testing.assert_allclose(ends[CONTACT], (push * left).sum(), rtol=1e-9)
    np.testing.assert_allclose(ends[INERTIAL], 0.125 * H**2 * (mass * a * a).sum(), rtol=1e-9)
    np.testing.assert_allclose(ends[KINETIC], 0.5 * (mass * v * v).sum(), rtol=1e-9)
    momentum = mass * v
    expected = [momentum.sum(axis=1), np.cross(x.T, momentum.T).sum(axis=0), (mass * x).sum(axis=1)]
    np.testing.assert_allclose(sums.momenta, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ends[DAMPING], (damping * v * left).sum() if damped else 0.0, rtol=1e-9)
    np.testing.assert_allclose(ends[EXTERNAL], (external * left).sum() if loaded else 0.0, rtol=1e-9)
