"""Compiles the loops that first runs need: those of the jobs of the benchmark, and of all material laws."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from ..case.schema import Case
from ..mechanics.compiled import Compilation
from ..mechanics.materials.base import LAWS
from ..output.units import duration
from ..registry import choices, lookup
from ..simulation import Simulation
from .measure import DENSITY, YOUNG_MODULUS, Job, time_job, tiny_jobs

PATIENCE = 1.0
"""Seconds of compilations for a piece of the work up to which nothing is said."""


def compile_loops(jobs: list[Job], kind: str, explicit: str, comm: MPI.Comm) -> None:
    """Make a few steps of each job on a lattice of a ``kind``, and ``explicit`` steps of each law. The ranks of a
    machine share them: each takes the next one when it is ready, and says what takes long. Collective."""
    tiny = tiny_jobs(explicit)[0]
    work: dict[str, Callable[[], Any]] = {
        **{job.name: partial(time_job, job, kind, 2, MPI.COMM_SELF, 0.0) for job in jobs},
        tiny.name: partial(time_job, tiny, "cubic", 2, MPI.COMM_SELF, 0.0, 3000),
        **{f"law {name}": partial(_run, name, explicit) for name in choices(LAWS)},
    }
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="pfem_compile_") as own:
        taken = Path(machine.bcast(own))
        for k, (name, make) in enumerate(work.items()):
            if _is_first(taken / str(k)):
                place = f"{name}, {k + 1} of {len(work)}"
                with Compilation(partial(_tell, place, begin), lambda seconds: None, PATIENCE):
                    make()
        comm.Barrier()
    machine.Free()
    if comm.size > 1:
        with Compilation(partial(_tell, f"{comm.size} ranks", begin), lambda seconds: None, PATIENCE):
            time_job(jobs[0], kind, 2, comm, 0.0)


def _tell(place: str, begin: float, loop: str, seconds: float) -> None:
    """Say which loop is being compiled for a piece of the work, and for how long all of it has lasted."""
    print(f"compiling loops: {place}: {loop}, {duration(time.perf_counter() - begin)} so far", flush=True)


def _is_first(place: Path) -> bool:
    """Return whether no other rank has made a file, which is made then."""
    try:
        place.open("x").close()
    except FileExistsError:
        return False
    return True


def law_case(name: str, explicit: str) -> Case:
    """Return a case with a law, on a floor; keys that the law needs are 1 in SI units, which all laws accept."""
    material: dict[str, Any] = {"law": name, "young_modulus": YOUNG_MODULUS, "density": DENSITY}
    for key, field in lookup(LAWS, name, "").Parameters.model_fields.items():
        if field.is_required() and key not in material:
            material[key] = 1.0 if field.annotation is float else [[1.0 / YOUNG_MODULUS, 1.0]]
    table = {
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [2, 2, 2], "pitch": 1.0},
        "material": {"it": material},
        "section": {"all": {"area": 1e-4, "shape": "round", "material": "it"}},
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0]}],
        "time": {"integrator": explicit, "step": 1e-6, "end": 2e-6},
    }
    return Case.from_dict(table, source=name)


def _run(law: str, explicit: str) -> None:
    told = io.StringIO()  # warnings about values that nobody means
    with tempfile.TemporaryDirectory(prefix="pfem_compile_") as folder, contextlib.redirect_stderr(told):
        Simulation(law_case(law, explicit), MPI.COMM_SELF, output=folder, quiet=True).run()
