"""Lumped and consistent mass and damping, supports and loads over time."""

import numpy as np
import pytest
from helpers.twins import Law, whole_truss

from pfem_petsc import Case
from pfem_petsc.stepping.model import Model

pytestmark = pytest.mark.parallel

AREA, DENSITY, DAMPING = 2e-3, 7800.0, 350.0


@pytest.fixture
def model(comm):
    def make(mass, **tables):
        return Model(
            Case.from_dict(
                {
                    "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 1.0},
                    "node_set": {"base": {"box": [[-1.0, -1.0, -0.1], [2.0, 2.0, 0.1]]}, "all": {"all": True}},
                    "material": {"it": Law(70e9).case(density=DENSITY, damping=DAMPING)},
                    "section": {"it": {"area": AREA, "material": "it"}},
                    "time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4, "mass": mass},
                    **tables,
                }
            ),
            comm,
        )

    return make


def owned(model):
    return model.mesh.node_ids[: model.mesh.n_owned]


def test_lumped_mass_is_half_of_every_bar(model):
    it = model("lumped")
    twin = whole_truss(it, AREA, Law(70e9))
    expected = twin.lumped_mass(DENSITY)
    np.testing.assert_allclose(it.inertia.mass, expected[owned(it)], rtol=1e-13)
    np.testing.assert_allclose(it.inertia.damping, twin.lumped_mass(DAMPING)[owned(it)], rtol=1e-13)
    assert it.total_mass == pytest.approx(DENSITY * AREA * twin.rest.sum(), rel=1e-13)


def test_products_with_consistent_mass_and_damping(model):
    it = model("consistent")
    twin = whole_truss(it, AREA, Law(70e9))
    a = np.random.default_rng(2).normal(size=(it.mesh.n_nodes, 3))
    mine = a[owned(it)]
    mass, damping = twin.consistent_mass(DENSITY) @ a, twin.consistent_mass(DAMPING) @ a
    out = np.empty_like(mine)
    np.testing.assert_allclose(it.inertia.mass_times(mine, out), mass[owned(it)], atol=1e-13 * np.abs(mass).max())
    scale = 1e-13 * np.abs(damping).max()
    np.testing.assert_allclose(it.inertia.damping_times(mine, out), damping[owned(it)], atol=scale)


def test_consistent_mass_of_a_rigid_translation_is_the_lumped_one(model):
    it = model("consistent")
    ones = np.ones((it.mesh.n_owned, 3))
    out = it.inertia.mass_times(ones, np.empty_like(ones))
    np.testing.assert_allclose(out, np.repeat(it.inertia.mass[:, None], 3, axis=1), rtol=1e-13)


def test_loads_follow_their_tables_and_gravity_the_masses(model):
    it = model(
        "lumped",
        load=[
            {"node_set": "base", "force": [1.0, 2.0, 3.0], "table": [[1.0, 0.5], [3.0, 1.5]]},
            {"node_set": "all", "force": [0.0, 0.0, 4.0]},
        ],
        gravity={"acceleration": [0.0, 0.0, -9.81]},
    )
    base = np.abs(it.mesh.points[: it.mesh.n_owned, 2]) < 0.1
    for time, factor in ((0.0, 0.5), (1.0, 0.5), (2.5, 1.25), (3.0, 1.5), (9.0, 1.5)):
        expected = np.zeros((it.mesh.n_owned, 3))
        expected[:, 2] = 4.0 - 9.81 * it.inertia.mass
        expected[base] += factor * np.array([1.0, 2.0, 3.0])
        np.testing.assert_allclose(it.external.at(time, np.empty_like(expected)), expected, rtol=1e-13)


def test_supports_move_as_told(model):
    it = model(
        "lumped", support=[{"node_set": "base", "fix": "xz", "motion": [[0.0, 0.0, 0.0, 0.0], [2.0, 0.4, 0.0, -0.2]]}]
    )
    points = it.mesh.points[: it.mesh.n_owned]
    base = np.abs(points[:, 2]) < 0.1
    assert np.array_equal(it.supports.fixed, np.outer(base, [True, False, True]))
    # between two rows s^2 (3 - 2 s) of the way
    for time, share in ((0.0, 0.0), (0.5, 0.15625), (1.0, 0.5), (2.0, 1.0), (5.0, 1.0)):
        expected = points + share * np.array([0.4, 0.0, -0.2])
        at = (it.supports.nodes, it.supports.components)
        np.testing.assert_allclose(it.supports.positions(time), expected[at], atol=1e-15)
