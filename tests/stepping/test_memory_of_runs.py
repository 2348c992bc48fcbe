"""Memory that an explicit run holds, in bytes a bar, and that freed memory goes back to the system."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest

from pfem_petsc import Case, Simulation

PITCH, YOUNG_MODULUS, DENSITY = 0.01, 110e9, 4500.0


def lattice(cells: int, **more: object) -> Case:
    table = {
        "title": "memory",
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [cells] * 3, "pitch": PITCH},
        "material": {"strut": {"young_modulus": YOUNG_MODULUS, "density": DENSITY}},
        "section": {"strut": {"area": 1e-6, "material": "strut"}},
        "initial": {"velocity": [0.0, 0.0, -20.0]},
        "time": {"integrator": "central_differences", "step": 1e-7, "end": 1e-6},
        "output": {"fields_every": 0, "fields": []},
    }
    return Case.from_dict(table | more, source="memory")


def held(case: Case, folder: Path) -> tuple[float, int]:
    """Return the traced memory [B] of a simulation after its set-up, and its number of bars."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        simulation = Simulation(case, output=folder, quiet=True)
        traced = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    bars = simulation.mesh.n_bars
    simulation.close()
    return traced, bars


@pytest.mark.parametrize("floor", [False, True])
def test_a_plain_explicit_run_holds_few_bytes_a_bar_after_its_set_up(tmp_path, floor):
    wall = {"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    more = {"wall": [wall]} if floor else {}
    held(lattice(2, **more), tmp_path / "first")  # modules are loaded
    small, few = held(lattice(8, **more), tmp_path / "small")
    large, many = held(lattice(16, **more), tmp_path / "large")
    # ends 8, rest length 8 and again, in the order of loops, 9, far end 4, number 4; eight vectors and eight numbers a
    # node, 0.12 nodes a bar
    assert (large - small) / (many - few) < 33.0 + 0.122 * (8 * 24 + 8 * 8)


def test_memory_of_large_arrays_goes_back_to_the_system_when_they_are_freed():
    program = """
import contextlib
import ctypes
from mpi4py import MPI
import numpy as np
from pfem_petsc.parallel.heap import returning_freed_memory

def resident():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS")) / 1024

library = ctypes.CDLL(None)
library.mallopt(-4, 0)  # as SuperLU_DIST does
library.mallopt(-1, -1)
for within in (contextlib.nullcontext, returning_freed_memory):
    with within():
        large, above = np.ones(1 << 23), np.ones(1000)
        before = resident()
        del large
        print(before - resident())
        del above
"""
    if not Path("/proc/self/status").exists() or sys.platform != "linux":
        pytest.skip("reads /proc")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    kept, returned = (float(word) for word in done.stdout.split())
    assert kept < 1.0
    assert returned > 60.0
