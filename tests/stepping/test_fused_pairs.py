"""Fused steps with contact pairs: bitwise identical to single steps."""

import numpy as np
import pytest
from helpers.bodies import two_lattices
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import EarlyStop
from pfem_petsc.mesh.ordering import NODE_BLOCK

CASES = {
    "free": {},
    "damped": {"material": {"damping": 50.0}},
    "held": {"supports": [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xyz"}]},
    "held, damped and heavy": {
        "supports": [{"node_set": "held", "fix": "x"}],
        "material": {"damping": 20.0},
        "gravity": (0.0, 0.0, -50.0),
    },
    "along an axis": {"direction": (1.0, 0.0, 0.0), "cells": (1, 3, 3)},
    "yielding": {"material": {"yield_stress": 1e4, "isotropic_hardening": 1e4, "kinematic_hardening": 1e4}},
    "many blocks": {"cells": (1, 14, 14), "end": 0.006},
}
ARRAYS = ("x", "v", "a", "f", "contact", "support")


def case(folder, output=None, **changes):
    tables = two_lattices(folder / "mesh.vtu", "central_differences", **changes)
    tables["output"] = {"fields_every": 0, "history_every": 3, "probe": [{"name": "held", "node_set": "held"}]}
    tables["output"] |= output or {}
    return tables


def made(tables, comm, folder, together):
    simulation = Simulation(Case.from_dict(tables), comm, output=folder, quiet=True)
    steps = list(simulation.batches() if together else simulation)
    return simulation, len(steps)


def compare(one, many, folder):
    first, second = open_result(folder / "one"), open_result(folder / "many")
    assert sorted(first.history) == sorted(second.history)
    for column in first.history:
        np.testing.assert_array_equal(first.history[column], second.history[column], err_msg=column)
    for what in ARRAYS:
        np.testing.assert_array_equal(getattr(one.state, what), getattr(many.state, what), err_msg=what)
    np.testing.assert_array_equal(one.model.links.force, many.model.links.force)
    np.testing.assert_array_equal(one.model.links.two.record.closed, many.model.links.two.record.closed)
    return first.history


@pytest.mark.parametrize("name", CASES)
def test_fused_steps_with_pairs_are_the_single_steps(name, tmp_path):
    tables = case(tmp_path, **CASES[name])
    one, count = made(tables, MPI.COMM_SELF, tmp_path / "one", False)
    many, fewer = made(tables, MPI.COMM_SELF, tmp_path / "many", True)
    assert fewer < count / 5
    assert name != "many blocks" or len(one.state.v) > 2 * NODE_BLOCK
    history = compare(one, many, tmp_path)
    assert history["active_contacts"].max() > 8 and np.ptp(history["active_contacts"]) > 8
    assert np.abs(history["pair/faces/impulse"][-1]).max() > 0.01 and history["impact_dissipation"][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()


def test_fused_steps_with_pairs_of_several_tables(tmp_path):
    tables = case(tmp_path, cells=(1, 3, 3))
    pair = tables["contact_pair"][0]
    for k, part in enumerate(("left", "right")):
        nodes = tables["node_set"][part]["indices"]
        low, high = nodes[: len(nodes) // 2], nodes[len(nodes) // 2 :]
        tables["node_set"] |= {f"low{k}": {"indices": low}, f"high{k}": {"indices": high}}
    tables["contact_pair"] = [
        pair | {"name": "high", "first": "high0", "second": "high1", "direction": [1.0, 0.0, 0.0]},
        pair | {"name": "low", "first": "low0", "second": "low1", "gap": 0.002},
    ]
    one, _ = made(tables, MPI.COMM_SELF, tmp_path / "one", False)
    many, fewer = made(tables, MPI.COMM_SELF, tmp_path / "many", True)
    assert fewer < 20
    history = compare(one, many, tmp_path)
    for name in ("low", "high"):
        assert np.abs(history[f"pair/{name}/impulse"][-1]).max() > 0.01


SQUEEZED = {
    "mesh": {
        "generator": "lattice",
        "kind": "cubic",
        "cells": [1, 11, 4],
        "pitch": 0.01,
    },  # whole planes of nodes for a rank
    "node_set": {"left": {"group": "left"}, "right": {"group": "right"}, "held": {"nearest": [0.0, 0.0, 0.0]}},
    "material": {"it": {"young_modulus": 110e9, "density": 4500.0}},
    "section": {"it": {"area": 1e-6, "material": "it"}},
    "initial": {
        "velocity": [0.0, 1.0, 0.0],
        "on": [{"node_set": "left", "velocity": [20.0, 0, 0]}, {"node_set": "right", "velocity": [-15.0, 2.0, 0]}],
    },
    "contact_pair": [{"name": "faces", "first": "left", "second": "right", "direction": [1, 0, 0], "gap": 0.00999}],
    "time": {"integrator": "central_differences", "step": 2e-7, "end": 4e-5},
    "output": {"fields_every": 0, "history_every": 3},
}


@pytest.mark.parallel
@pytest.mark.parametrize("supports", [[], [{"node_set": "held", "fix": "xyz"}]], ids=["free", "held"])
def test_ranks_make_fused_steps_with_pairs_of_their_own(supports, comm, shared_tmp_path):
    tables = SQUEEZED | {"support": supports}
    one, count = made(tables, comm, shared_tmp_path / "one", False)
    many, fewer = made(tables, comm, shared_tmp_path / "many", True)
    cut = comm.allreduce(int((one.model.links.two.nodes < 0).sum()))
    assert cut == 0 or comm.size > 2
    assert fewer == count if cut else fewer < count / 5
    history = compare(one, many, shared_tmp_path)
    assert history["active_contacts"].max() > 8 and np.ptp(history["active_contacts"]) > 8


@pytest.mark.parallel
def test_pairs_between_ranks_take_single_steps(comm, shared_tmp_path):
    simulation, count = made(case(shared_tmp_path, end=0.004), comm, shared_tmp_path / "out", True)
    cut = comm.allreduce(int((simulation.model.links.two.nodes < 0).sum()))
    assert count == 20 if cut else count < 10


@pytest.mark.parametrize("what", ["in several pairs", "with walls"])
def test_other_links_take_single_steps(what, tmp_path):
    tables = case(tmp_path, end=0.004)
    pair = tables["contact_pair"][0]
    if what == "in several pairs":
        tables["contact_pair"] = [pair, pair | {"name": "across", "direction": [1.0, -0.4, 0.3]}]
    else:
        tables["wall"] = [{"type": "plane", "point": [0, 0, -1.0], "normal": [0.0, 0.0, 1.0]}]
    _, count = made(tables, MPI.COMM_SELF, tmp_path / "out", True)
    assert count == 20


def test_a_stopped_run_with_pairs_goes_on_to_the_same_end(tmp_path):
    tables = case(tmp_path, output={"fields_every": 15})
    whole, _ = made(tables, MPI.COMM_SELF, tmp_path / "one", True)
    simulation = Simulation(Case.from_dict(tables), MPI.COMM_SELF, output=tmp_path / "many", quiet=True)
    with pytest.raises(EarlyStop):
        for _ in simulation.batches():
            if simulation.model.links.force.any():
                simulation._synchroniser.stop._signal = 15
    assert 0 < simulation.state.step < 100
    rest = Simulation(Case.from_dict(tables), MPI.COMM_SELF, output=tmp_path / "many", restart=True, quiet=True)
    for _ in rest.batches():
        pass
    compare(whole, rest, tmp_path)
