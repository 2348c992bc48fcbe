"""Single steps and the fused loop make the same phases: without any one of them they differ."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.stepping import stepper as phases

# A damped lattice that yields on a floor, so that each phase matters.
TABLES = {
    "mesh": {"generator": "lattice", "kind": "cubic", "cells": [1, 1, 2], "pitch": 0.01},
    "material": {"it": {"young_modulus": 110e9, "density": 4500.0, "damping": 2e4, "yield_stress": 1e7}},
    "section": {"it": {"area": 1e-6, "material": "it"}},
    "initial": {"velocity": [3.0, 1.0, -20.0]},
    "wall": [{"name": "floor", "type": "plane", "point": [0, 0, -1e-5], "normal": [0.0, 0.1, 1.0]}],
    "time": {"integrator": "central_differences", "step": 2e-7, "end": 8e-6},
    "output": {"fields_every": 0, "history_every": 10},
}
LEFT_OUT = phases.begin, phases.treat, phases.check
"""Without effect where the fused loop applies."""


def outcome(folder, together):
    simulation = Simulation(Case.from_dict(TABLES), output=folder, quiet=True)
    for _ in simulation.batches(min_steps=1) if together else simulation:
        pass
    result = open_result(folder)
    columns = {name: result.history[name] for name in result.history}
    return columns | {name: getattr(simulation.state, name) for name in ("x", "v", "a", "f", "contact")}


def same(one, other):
    return all(np.array_equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    return outcome(tmp_path_factory.mktemp("fused"), together=True)


def test_all_phases_give_the_fused_steps(fused, tmp_path):
    assert fused["wall/floor/contacts"].any() and fused["plastic_dissipation"].any()
    assert same(fused, outcome(tmp_path, together=False))


@pytest.mark.parametrize("phase", [phase for phase in phases.MOVES_FIRST if phase not in LEFT_OUT])
def test_no_phase_can_be_missing(phase, fused, tmp_path, monkeypatch):
    monkeypatch.setattr(phases, "MOVES_FIRST", tuple(one for one in phases.MOVES_FIRST if one is not phase))
    if phase in (phases.balance, phases.solve, phases.finish):  # the nodes do not notice the wall
        with pytest.raises(SimulationFailure, match="beyond wall 'floor'"):
            outcome(tmp_path, together=False)
    else:
        assert not same(fused, outcome(tmp_path, together=False))


@pytest.mark.parametrize("phase", LEFT_OUT)
def test_other_phases_have_nothing_to_do_there(phase, fused, tmp_path, monkeypatch):
    monkeypatch.setattr(phases, "MOVES_FIRST", tuple(one for one in phases.MOVES_FIRST if one is not phase))
    assert same(fused, outcome(tmp_path, together=False))
