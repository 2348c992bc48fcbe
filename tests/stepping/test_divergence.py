"""Divergence ends a run at the first certain sign, and messages of one kind are told once."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.columns import ENERGIES
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.run.monitors import BlowUp


def pendulum(comm, folder, integrator, degrees, modulus=1e8, steps=30, **keys):
    """A bar about its end, spinning by an angle a step at first, or falling by it where it is fastest."""
    rate = np.sqrt(2.0 * 9.81)
    step = np.radians(degrees) / rate
    case = {
        "node_set": {"pin": {"indices": [0]}},
        "material": {"m": {"young_modulus": modulus, "density": 2.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "support": [{"node_set": "pin", "fix": "xyz"}],
        "time": {"integrator": integrator, "step": step, "end": steps * step, "mass": "lumped"},
        "output": {"fields_every": 0},
        **keys,
    }
    case = Case.from_dict(case, mesh=Truss(np.array([[0.0, 0, 0], [1, 0, 0]]), [[0, 1]]))
    return Simulation(case, comm, output=folder, quiet=True)


def row_of(number, **energies):
    """A row of the history with some energies [J]."""
    return {
        "step": number,
        "time": 0.1 * number,
        "active_contacts": 0,
        **dict.fromkeys((e.name for e in ENERGIES), 0.0),
        **energies,
    }


def check(watch, row, state):
    watch.check(row, row, state)


@pytest.mark.parallel
def test_energy_created_is_compared_with_what_moves_the_truss_in_its_stage(comm, shared_tmp_path):
    """Works of earlier stages (1 MJ), what their quadrature lost, and prestress (0.5 MJ) do not hide that 20 J of
    motion become 400 J: the sixth row beyond twenty times the 20 J is the last, also after a restart between them."""
    simulation = pendulum(comm, shared_tmp_path / "it", "newmark", 1.0)
    simulation.start()
    state, start = simulation.state, {"elastic_energy": 5e5, "external_work": 1e6, "numerical_dissipation": 5e5}
    watch = BlowUp(simulation.model)
    check(watch, row_of(100, **start), state)
    for number, created in enumerate([0.0, 1.0, 50.0, 350.0, 410.0, 450.0, 450.0, 450.0, 450.0]):
        moved = {"external_work": 1e6 + 20.0, "kinetic_energy": 20.0 + created}
        check(watch, row_of(101 + number, **{**start, **moved, "numerical_dissipation": 5e5 - created}), state)
    again = BlowUp(simulation.model)
    again.kept = watch.kept
    last = {**start, "external_work": 1e6 + 20.0, "kinetic_energy": 520.0, "numerical_dissipation": 5e5 - 500.0}
    with pytest.raises(SimulationFailure, match=r"step 110, t = 11 s: .* created 500 J, but only 20 J .*time\.step"):
        check(again, row_of(110, **last), state)
    simulation.close()


def test_released_energy_may_move_the_truss(comm, shared_tmp_path):
    """What prestressed bars release is energy supplied: a hundred times the work of loads is no divergence."""
    simulation = pendulum(comm, shared_tmp_path / "it", "newmark", 1.0)
    simulation.start()
    watch = BlowUp(simulation.model)
    for number in range(20):
        energies = {"elastic_energy": 1000.0 - 50.0 * number, "kinetic_energy": 60.0 * number}
        check(watch, row_of(number, **energies, numerical_dissipation=-10.0 * number), simulation.state)
    simulation.close()


NET = {
    "mesh": {"generator": "net", "size": [20.0, 20.0], "cells": [4, 4]},
    "node_set": {f"c{k}": {"group": f"corner_{k}"} for k in (1, 2, 3, 4)},
    "material": {"cable": {"law": "cable", "young_modulus": 160e9, "density": 7850.0, "damping": 8e3}},
    "section": {"all": {"area": 2e-4, "material": "cable", "pretension": 20e3, "diameter": 0.3}},
    "support": [
        {"node_set": f"c{k}", "fix": "xyz"} | ({"motion": [[0, 0, 0, 0], [1, 0, 0, 4.0]]} if k in (1, 3) else {})
        for k in (1, 2, 3, 4)
    ],
    "gravity": {"acceleration": [0.0, 0.0, -9.81]},
    "output": {"fields_every": 0},
}


@pytest.mark.slow
def test_gust_on_a_saddle_net_at_too_large_steps_is_stopped(comm, shared_tmp_path):
    """Form finding supplies 0.5 MJ of prestress, and drag takes energy: neither is a source of the 4 kJ that the
    integration creates, where the gust supplies some 100 J."""
    gust = {"velocity": [[0, 0, 0, 0], [1, 25, 0, 0], [1.5, 25, 0, 0], [2.5, 0, 0, 0]]}
    time = {"integrator": "generalized_alpha", "step": 1e-2, "end": 3.5}
    stages = [{"name": "form", "static": {"method": "relaxation"}}, {"name": "gust", "time": time, "wind": gust}]
    simulation = Simulation(Case.from_dict(NET | {"stage": stages}), comm, output=shared_tmp_path / "it", quiet=True)
    with pytest.raises(SimulationFailure, match=r"the motion is unstable and fastest at node .*reduce time\.step"):
        simulation.run()
    assert simulation.row["kinetic_energy"] < 1e5


@pytest.mark.parallel
def test_failures_of_one_kind_are_told_once_and_counted(comm, shared_tmp_path):
    """A fall at 60 degrees a step is rejected again and again: the log has one message, and the number at the end."""
    gravity = {"acceleration": [0.0, 0.0, -9.81]}
    simulation = pendulum(comm, shared_tmp_path / "it", "newmark", 60.0, gravity=gravity)
    rows = [step.row for step in simulation]
    remarks = simulation.stepper.remarks()
    bisected = sum(row["step_size"] < 0.99 * simulation.stepper.h for row in rows)
    failed = simulation.stepper.failures
    assert bisected > 1 and failed.total() >= bisected
    if comm.rank == 0:
        log = (shared_tmp_path / "it" / "log.txt").read_text()
        assert log.count("bisecting the step") == len(failed) < failed.total()
        assert log.count(f"{failed.total()} solves failed") == 1 and remarks[0] in log
