"""Forces, energies and fields of a lattice against whole-mesh NumPy, on any number of ranks."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.twins import Law, shaken, whole_truss

from pfem_petsc import Case
from pfem_petsc.stepping.model import Model

pytestmark = pytest.mark.parallel

AREA = 2e-3
ELASTIC = Law(70e9)
PLASTIC = Law(70e9, 90e6, isotropic=3e9, kinematic=5e9)
LAWS = [
    pytest.param(replace(law, strain=strain), id=f"{name}-{strain}")
    for name, law in (("elastic", ELASTIC), ("plastic", PLASTIC))
    for strain in ("engineering", "green", "logarithmic")
]


@pytest.fixture
def truss(comm):
    """A model of a small lattice and its twin; the twin's bars have a plastic past where the law has one."""

    def make(law):
        case = Case.from_dict(
            {
                "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 1.0},
                "material": {"it": law.case()},
                "section": {"it": {"area": AREA, "material": "it"}},
                "time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4},
            }
        )
        model = Model(case, comm)
        twin = whole_truss(model, AREA, law)
        if law.yield_stress is not None:
            random = np.random.default_rng(8)
            twin.plastic = random.uniform(-2e-3, 2e-3, len(twin.bars))
            twin.accumulated = np.abs(twin.plastic) + random.uniform(0.0, 2e-3, len(twin.bars))
            for block in model.bars.blocks:
                ids = model.mesh.bar_ids[block.start : block.stop]
                block.put_row(0, twin.plastic[ids])
                block.put_row(1, twin.accumulated[ids])
        return model, twin

    return make


def local(model, values):
    """Rows of an array in mesh numbering at this rank's nodes, ghosts included."""
    return np.ascontiguousarray(values[model.mesh.node_ids])


def whole(model, values):
    """An array of this rank's nodes (or more) in mesh numbering, the same on every rank."""
    mesh = model.mesh
    out = np.zeros((mesh.n_nodes, *values.shape[1:]))
    out[mesh.node_ids[: mesh.n_owned]] = values[: mesh.n_owned]
    return model.comm.allreduce(out)


@pytest.mark.parametrize("law", LAWS)
def test_forces_energies_and_fields(law, truss):
    model, twin = truss(law)
    x = shaken(twin, 4e-3)
    f = np.empty((model.mesh.n_local, 3))
    energy = model.bars.forces(local(model, x), f, commit=True)
    expected = twin.forces(x)
    assert np.abs(whole(model, f) - expected).max() < 1e-12 * np.abs(expected).max()
    bar = twin.response(x)
    volume = AREA * twin.rest
    names = ("elastic_energy", "plastic_heat", "hardening_energy")
    elastic, heat, hardening = (model.comm.allreduce(energy.of(name)) for name in names)
    assert elastic == pytest.approx(volume @ (0.5 * bar["stress"] ** 2 / law.young_modulus), rel=1e-12)
    if law.yield_stress is not None:
        accumulated, plastic = bar["accumulated"], bar["plastic_strain"]
        assert heat == pytest.approx(volume @ (law.yield_stress * accumulated), rel=1e-12)
        stored = 0.5 * law.isotropic * accumulated**2 + 0.5 * law.kinematic * plastic**2
        assert hardening == pytest.approx(volume @ stored, rel=1e-12)
        yielding = np.mean(accumulated > twin.accumulated)
        assert 0.1 < yielding < 0.9  # both branches of the law were met
    else:
        assert heat == hardening == 0.0
    fields = model.bars.fields(local(model, x))
    for name in ("strain", "stress", "axial_force", "plastic_strain"):
        expected = bar[name][model.mesh.bar_ids]
        assert np.abs(fields[name] - expected).max(initial=0.0) <= 1e-12 * np.abs(bar[name]).max(), name
