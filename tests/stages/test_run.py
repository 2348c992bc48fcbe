"""Stages on one state: continuity, balances and restarts."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.kills import differences
from helpers.small_models import BLOCK, DOME, check_balances
from helpers.stopped import assert_restart_is_bitwise, everywhere
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError


def run(data, comm, folder, stop_after=-1, **options):
    """Run to the end, or to a step after which a checkpoint is written; the step that was reached."""
    with Simulation(Case.from_dict(data, name="block"), comm, output=folder, quiet=True, **options) as simulation:
        for made in simulation:
            if made.step == stop_after:
                simulation.outputs.checkpointing.observe()
                break
        return simulation.stepper.number


@pytest.mark.slow
@pytest.mark.parallel
def test_four_stages_on_one_state(comm, shared_tmp_path):
    run(BLOCK, comm, shared_tmp_path / "out")
    result = open_result(shared_tmp_path / "out")
    history = result.history
    check_balances({name: history[name] for name in history})
    assert history["step"][-1] == 58
    assert (np.diff(history["time"]) > 0.0).all()
    np.testing.assert_allclose(history["time"][[0, 4, 16, -1]], [0.0, 1.0, 1.0 + 6e-5, 2.0 + 1e-4], rtol=1e-12)
    np.testing.assert_array_equal(np.unique(history["stage"], return_index=True)[1], [0, 5, 17, 31])
    assert (np.diff(result.times) > 0.0).all()
    # the end of each stage has a row and a snapshot
    assert {4, 16, 56, 58} <= set(history["step"]) & set(result.steps)
    assert history["plastic_dissipation"][4] > 0.0
    assert (history["wall/plate/force"][1:17, 2] < 0.0).all()
    assert not history["wall/plate/force"][17:].any()
    assert result.attributes["stages"] == ["press", "shake", "fly", "settle"]
    log = (shared_tmp_path / "out" / "log.txt").read_text()
    for end in ("4, load factor 1", "16, t = 1.000 s", "56, t = 1.000 s"):
        assert f"begins after step {end}\n" in log
    assert re.search(r"done: 58 steps.*, load factor 1, ", log)


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_in_any_stage_is_bitwise(comm, shared_tmp_path):
    # MUMPS, which small models take on several ranks, repeats to rounding only
    case = Case.from_dict({**BLOCK, "solver": {"linear": "cg"}})
    assert_restart_is_bitwise(case, comm, shared_tmp_path, 3, 4, 10, 30, 57)


@pytest.mark.slow
def test_a_later_end_of_the_last_stage_continues_it(comm, shared_tmp_path, capsys):
    data = {**BLOCK, "solver": {"linear": "cg"}, "output": {**BLOCK["output"], "checkpoint_every": 1000}}
    first, last = BLOCK["stage"][0], BLOCK["stage"][2]
    cases = [{**data, "stage": [first, {**last, "time": {**last["time"], "end": end}}]} for end in (4e-5, 9e-5)]
    whole, continued = shared_tmp_path / "whole", shared_tmp_path / "continued"
    assert run(cases[1], comm, whole) == 94
    assert run(cases[0], comm, continued) == 44
    assert run(cases[1], comm, continued, restart=True) == 94
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in (whole, continued))) == {}
    finished = Simulation(Case.from_dict(cases[1], name="block"), comm, output=continued, quiet=True, restart=True)
    assert finished.finished
    finished.close()
    with Simulation(Case.from_dict(cases[0], name="block"), comm, output=continued, restart=True) as finished:
        assert finished.run() == 0
    if comm.rank == 0:
        assert "t = 90.00 µs of the last stage, beyond stage[1].time.end = 40.00 µs" in capsys.readouterr().out
    other = {**cases[1], "stage": [{**first, "static": {"step": 0.5}}, cases[1]["stage"][1]]}
    with pytest.raises(InputError, match=r"stage\[0\]\.static\.step: 0\.25 -> 0\.5"):
        run(other, comm, continued, restart=True)


@pytest.mark.slow
def test_a_later_stage_that_cannot_run_is_found_before_the_first_step(tmp_path):
    wrong = {"name": "wrong", "time": {"integrator": "central_differences", "step": 1.0, "end": 2.0}}
    with pytest.raises(InputError, match=r"stage\[4\]: time\.step = 1 s is above the limit"):
        run({**BLOCK, "stage": [*BLOCK["stage"], wrong]}, MPI.COMM_SELF, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_modes_are_those_of_the_end_of_the_last_stage(tmp_path):
    gravity = {"gravity": {"acceleration": [0.0, 0.0, -9.81]}, "modes": {"count": 2}}
    weight = {"name": "weight", "static": {"step": 0.5}}
    short = {"name": "short", "static": {"step": 0.5}, "load": []}
    data = {key: value for key, value in DOME.items() if key != "stage"} | gravity
    run({**data, "static": {"step": 0.5}}, MPI.COMM_SELF, tmp_path / "one")
    run({**data, "stage": [weight, short]}, MPI.COMM_SELF, tmp_path / "two")
    one, two = (open_result(tmp_path / name).modes.frequency for name in ("one", "two"))
    np.testing.assert_allclose(two, one, rtol=1e-9)


@pytest.mark.slow
def test_the_displacement_of_a_path_counts_from_the_start_of_its_stage(tmp_path):
    path = {**DOME["stage"][0]["static"], "displacement": 1e-3}
    stages = [{**DOME["stage"][0], "name": name, "static": path} for name in ("once", "again")]
    probe = {"output": {"fields_every": 0, "probe": [{"name": "apex", "node_set": "apex"}]}}
    run({**DOME, **probe, "stage": stages}, MPI.COMM_SELF, tmp_path / "out")
    history = open_result(tmp_path / "out").history
    z = history["probe/apex/position"][:, 0, 2]
    ends = [int(np.flatnonzero(history["stage"] == stage)[-1]) for stage in (0, 1)]
    np.testing.assert_allclose([z[0] - z[ends[0]], z[ends[0]] - z[ends[1]]], 1e-3, rtol=1e-9)


@pytest.mark.parallel
def test_warnings_of_all_stages_are_told_once(comm, shared_tmp_path, capfd):
    """That the step is too large for the damping, in the first stage; and walls that are not touched, by stage."""
    walls = [{"name": "near", "point": [0.0, 0.0, -5e-6]}, {"name": "far", "point": [0.0, 0.0, -9.0]}]
    time = {"integrator": "central_differences", "step": 1e-6, "end": 2e-5}
    data = {
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [1, 1, 1], "pitch": 1.0},
        "material": {"it": {"young_modulus": 1e9, "density": 1e3, "damping": 3e8}},
        "section": {"it": {"area": 1e-4, "material": "it"}},
        "wall": [{"type": "plane", "normal": [0.0, 0.0, 1.0], **wall} for wall in walls],
        "stage": [
            {"name": "rest", "time": time},
            {"name": "hit", "time": time, "initial": {"velocity": [0.0, 0.0, -4.0]}},
        ],
    }
    run(data, comm, shared_tmp_path / "out")
    log, told = (shared_tmp_path / "out" / "log.txt").read_text(), capfd.readouterr().err
    if comm.rank == 0:
        assert told.count("damping stops nodes") == log.count("damping stops nodes") == 1
    found = re.findall(r"wall '(\w+)' was never touched by a node in stage '(\w+)'", log)
    assert found == [("near", "rest"), ("far", "rest"), ("far", "hit")]
