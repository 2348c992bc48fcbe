"""Strength of octet lattices whose struts yield or buckle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.runs import run_with_fields

from pfem_petsc import Case, Simulation, open_result


def octet_strength(area, cells, comm, folder):
    """Largest force [N] on octet cells of round struts of an area, pressed by 1.2 % between frictionless plates."""
    side, height = 0.01 * cells[0], 0.01 * cells[2]
    case = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": cells, "pitch": 0.01},
            "node_set": {
                "bottom": {"group": "bottom"},
                "top": {"group": "top"},
                "corner": {"nearest": [0.0, 0.0, 0.0]},
                "beside": {"nearest": [side, 0.0, 0.0]},
            },
            "material": {"m": {"law": "strut", "young_modulus": 70e9, "density": 2700.0, "yield_stress": 200e6}},
            "section": {"s": {"area": area, "material": "m", "shape": "round"}},
            "support": [
                {"node_set": "bottom", "fix": "z"},
                {"node_set": "corner", "fix": "xy"},
                {"node_set": "beside", "fix": "y"},
                {
                    "node_set": "top",
                    "fix": "z",
                    "motion": [[0, 0, 0, 0], [1, 0, 0, -0.012 * height]],
                    "interpolation": "linear",
                },
            ],
            "static": {"step": 0.05},
            "output": {"fields_every": 0, "probe": [{"name": "top", "node_set": "top"}]},
        }
    )
    history, _ = run_with_fields(case, comm, folder)
    return -history["probe/top/reaction"][:, :, 2].sum(axis=1).min()


@pytest.mark.parallel
@pytest.mark.slow
def test_strength_of_an_octet_cell_follows_yield_and_euler(comm, shared_tmp_path):
    """Areas over 16 to 1: with the area where struts yield, with its square where they buckle."""
    areas = 4.5e-8 * 4.0 ** np.arange(3)  # slendernesses of 118, 59 and 30; 58.8 is that of both
    forces = np.array([octet_strength(area, [1, 1, 1], comm, shared_tmp_path / "out") for area in areas])
    slopes = np.diff(np.log(forces)) / np.log(4.0)
    assert slopes == pytest.approx([2.0, 1.0], abs=0.02)
    length = 0.01 / math.sqrt(2.0)
    euler = 0.25 * math.pi * 70e9 * areas[0] ** 2 / length**2
    # in both, the same multiple of the strength of a bar
    assert forces[0] / euler == pytest.approx(forces[2] / (200e6 * areas[2]), rel=0.03)


def crush(comm, folder, viscosity, strain, **keys):
    """Peak force [N] of a clamped octet cell that is pressed by a strain, in increments of 0.25 % strain."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 0.005},
            "node_set": {"bottom": {"group": "bottom"}, "top": {"group": "top"}},
            "material": {"m": {"law": "strut", "young_modulus": 190e9, "density": 7900.0, "yield_stress": 400e6}},
            "section": {"s": {"area": 2e-7, "material": "m", "shape": "round"}},
            "support": [
                {"node_set": "bottom", "fix": "xyz"},
                {
                    "node_set": "top",
                    "fix": "xyz",
                    "motion": [[0, 0, 0, 0], [1, 0, 0, -0.005 * strain]],
                    "interpolation": "linear",
                },
            ],
            "static": {"step": 0.0025 / strain, "stabilise": viscosity, **keys},
            "output": {"fields_every": 0, "probe": [{"name": "top", "node_set": "top"}]},
        }
    )
    with Simulation(case, comm, output=folder, quiet=True) as simulation:
        simulation.run()
        remarks = simulation.stepper.remarks()
    with open_result(folder / "result.vtkhdf") as result:
        history = dict(result.history)
    return -history["probe/top/reaction"][:, :, 2].sum(axis=1).min(), history, remarks


@pytest.mark.slow
def test_share_of_stabilise_is_told_once(comm, shared_tmp_path):
    """A smaller largest share is exceeded: one warning, and its number again at the end."""
    _, history, remarks = crush(comm, shared_tmp_path / "it", 1e-2, 0.05, stabilise_share=1e-4)
    share = history["damping_dissipation"][-1] / (
        history["elastic_energy"][-1] + history["plastic_dissipation"][-1] + history["damping_dissipation"][-1]
    )
    assert share > 1e-4
    told = float(remarks[0].partition("(damping_dissipation), ")[2].partition(" %")[0])
    assert told == pytest.approx(100.0 * share, rel=0.01)
    if comm.rank == 0:
        log = (shared_tmp_path / "it" / "log.txt").read_text()
        assert log.count("more than static.stabilise_share = 0.0001") == 1
