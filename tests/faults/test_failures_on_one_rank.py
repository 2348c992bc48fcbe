"""Failures of one rank of a Python program, wherever it is: all ranks end, with its traceback, and nothing hangs."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.launch import environment

from pfem_petsc import open_result

HEAD = """
import sys, time
from mpi4py import MPI
from pfem_petsc import Case, InputError, Simulation, SimulationFailure, open_result
comm = MPI.COMM_WORLD
rank = comm.rank
case = Case.load("rod_impact", ["time.end=1", "output.fields_every=0"])

def fail(step, error=ValueError("surprise")):
    if rank == comm.size - 1 and step.step == 10:
        raise error

def make():
    return Simulation(case, output="out", quiet=True)

"""

ALONE = "has failed alone"
LEFT = "has left the loop over steps"
PROGRAMS = {  # lines, status, what stderr has, and the last row of the history
    "in a loop": ("with make() as s:\n    for step in s:\n        fail(step)", 1, LEFT, 10),
    "in a loop without a context": ("for step in make():\n    fail(step)", 1, LEFT, 10),
    "in a loop over batches": (
        "for step in make().batches():\n    if rank == 1 and step.step >= 10: raise ValueError('surprise')",
        1,
        LEFT,
        None,
    ),
    "in a loop where others wait": (
        "with make() as s:\n    for step in s:\n        fail(step)\n        s.gather(s.state.v)",
        1,
        ALONE,
        None,
    ),
    "in a function after steps where others wait": (
        "s = make()\ns.on_step(lambda step: (fail(step), comm.Barrier()))\ns.run()",
        1,
        ALONE,
        None,
    ),
    "a failure of a simulation there": (
        "s = make()\ns.on_step(lambda step: (fail(step, SimulationFailure('surprise')), comm.Barrier()))\ns.run()",
        1,
        ALONE,
        None,
    ),
    "in a force where others wait": (
        "def force(t, state):\n    if rank and t > 0.1: raise ValueError('surprise')\n"
        "    comm.Barrier()\n    return 0.0 * state.velocity\n"
        "with make() as s:\n    s.external_force(force)\n    s.run()",
        1,
        ALONE,
        None,
    ),
    "outside, before": ("if rank: raise ValueError('surprise')\nmake()", 1, ALONE, None),
    "outside, within": ("with make() as s:\n    if rank: raise InputError('surprise')\n    s.run()", 1, ALONE, None),
    "outside, after": ("make().run()\nif rank: raise ValueError('surprise')\ncomm.Barrier()", 1, ALONE, 100),
    "a status": ("if rank: sys.exit('surprise')\nmake()", 1, ALONE, None),
    "a status in a loop": ("for step in make():\n    fail(step, SystemExit('surprise'))", 1, LEFT, 10),
    "caught by that rank": (
        "try:\n    for step in make():\n        fail(step)\n        comm.Barrier()\n"
        "except ValueError as error:\n    print(error, file=sys.stderr)",
        1,
        ALONE,
        None,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", PROGRAMS)
def test_failure_of_one_rank_ends_all(where, on_ranks, tmp_path):
    lines, status, told, last = PROGRAMS[where]
    (tmp_path / "program.py").write_text(HEAD + lines)
    done = on_ranks(2, "program.py", cwd=tmp_path, timeout=200.0)
    assert done.returncode == status, done.stderr
    assert "surprise" in done.stderr and told in done.stderr
    if told == ALONE:
        assert f"rank 1 {ALONE}" in done.stderr and f"rank 0 {ALONE}" not in done.stderr
    if last is not None:
        with open_result(tmp_path / "out") as result:
            assert result.history["step"][-1] == last


GOOD = """
class Broken(Exception): pass

# all ranks leave alike, one of them much later than the others may wait after a failure
for step in make():
    if step.step == 5:
        time.sleep(4.0 * (rank == 0))
        break
comm.Barrier()
assert rank or open_result("out").history["step"][-1] == 5
# exceptions that all ranks catch
for error in (Broken(), KeyboardInterrupt(), SystemExit(3)):
    try:
        with make() as s:
            for step in s:
                if step.step == 5:
                    raise error
    except BaseException as caught:
        assert caught is error
# that of one rank, and what the others get of it
try:
    with make() as s:
        for step in s:
            fail(step, Broken())
except (Broken, SimulationFailure) as error:
    assert isinstance(error, Broken) == (rank == comm.size - 1)
try:
    make().on_step(1)
except InputError:
    pass
with make() as s, Simulation(case, MPI.COMM_SELF, output=f"own{rank}", quiet=True) as own:
    assert s.run() == own.run() == 0
assert rank or open_result("out").history["step"][-1] == 100
if rank == 0:
    time.sleep(4.0)
    print("all well", flush=True)
sys.exit(0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [2, 3])
def test_programs_that_go_on_or_end_well(ranks, on_ranks, tmp_path):
    (tmp_path / "program.py").write_text(HEAD + GOOD)
    done = on_ranks(ranks, "program.py", cwd=tmp_path, timeout=200.0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("all well") == 1 and ALONE not in done.stderr


@pytest.mark.slow
def test_failure_of_all_ranks_is_told_without_delay(on_ranks, tmp_path):
    (tmp_path / "program.py").write_text(HEAD + "make()\nraise ValueError('surprise')")
    done = on_ranks(2, "program.py", cwd=tmp_path, timeout=200.0)
    assert done.returncode == 1
    assert done.stderr.count("ValueError: surprise") == 2 and "MPI_ABORT" not in done.stderr + done.stdout


@pytest.mark.slow
def test_failure_on_a_single_rank(tmp_path):
    """Without a launcher: as Python tells it."""
    (tmp_path / "program.py").write_text(
        HEAD + "assert sys.excepthook is sys.__excepthook__\nfor step in make():\n    fail(step)"
    )
    command = [sys.executable, "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr.endswith("ValueError: surprise\n")
    assert done.stderr.startswith("Traceback (most recent call last):")
