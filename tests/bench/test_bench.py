"""The bench: its lattices, its bytes, its memory, its verb."""

import json
import subprocess
import sys

import numpy as np
import pytest

from pfem_petsc import Simulation
from pfem_petsc.bench import CROSSING, JOBS, KINDS, Job, PeakMemory, cells_for, make_case


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cells", [1, 3])
def test_bars_are_those_of_the_generator(kind, cells):
    from pfem_petsc.mesh.generators import lattice

    slab = lattice.generate(lattice.Parameters(kind=kind, cells=(cells, cells, cells), pitch=1.0), 0, 1)
    assert len(slab.bars) == KINDS[kind](cells)


def test_nearest_lattice():
    assert [cells_for("cubic", bars) for bars in (1, 10_000, 100_000, 1_000_000)] == [1, 10, 22, 48]
    for kind in KINDS:
        found = KINDS[kind](cells_for(kind, 5000))
        assert all(abs(found - 5000) <= abs(KINDS[kind](n) - 5000) for n in range(1, 20))


def test_memory_sees_what_was_used_and_freed():
    size = 200_000_000
    array = np.ones(size // 8)  # a peak before the one that is measured
    del array
    memory = PeakMemory()
    array = np.ones(size // 16)
    # the kernel counts pages with an error of some dozen
    assert 0.49 * size <= memory.growth() < 0.6 * size
    del array
    assert 0.49 * size <= memory.growth() < 0.6 * size


@pytest.mark.slow
def test_contact_jobs_touch_the_floor_in_every_step(tmp_path):
    job = Job("contact", "central_differences", contact=True, plastic=True, step=0.02 * CROSSING)
    simulation = Simulation(make_case(job, "cubic", 3, 100), output=tmp_path, quiet=True)
    assert all(simulation.row["active_contacts"] == 16 for _ in simulation)


def bench(*options):
    command = [sys.executable, "-m", "pfem_petsc", "bench", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=240)


@pytest.mark.thorough
def test_the_verb_writes_what_it_measured(tmp_path):
    path = tmp_path / "bench.json"
    done = bench("--sizes", "100", "1000", "--seconds", "0.05", "-o", str(path))
    assert done.returncode == 0, done.stderr
    found = json.loads(path.read_text())
    assert found["bandwidth"]["alone"] > 1e8
    assert [run["job"] for run in found["runs"]] == 2 * list(JOBS)
    for run in found["runs"]:
        assert run["best"] <= run["median"]
        assert run["bars_per_second"] == pytest.approx(run["bars"] / run["median"])
        assert (run["newton"] > 0) == (run["job"] in ("matrix_free", "assembled", "implicit_contact"))
        assert f"{run['bars']:,}" in done.stdout
    assert {record["job"] for record in found["overhead"]} == {"tiny", "tiny, history every 10", "tiny, contact"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--sizes", "0"), "not a positive whole number"),
        (("--seconds", "-1"), "positive"),
        (("--sizes", "10", "--implicit", "newmrk", "--jobs", "assembled"), "newmark"),
        (("-o", "/proc/bench.json"), "cannot be written"),
        (("--sizes", "1e30"), "up to 1,000,000,000,000"),
    ],
)
def test_refusals(options, said):
    done = bench(*options)
    assert done.returncode == 2
    assert said in done.stderr
