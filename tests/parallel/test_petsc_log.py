"""``-log_view`` shows a run's stages and events by name, and a run without it has none of them."""

import re
import subprocess
import sys

import pytest

from pfem_petsc.parallel.petsc_log import EVENTS, STAGES

# What an explicit run has, and an implicit one that does not ask for a lagged preconditioner
EXPLICIT = set(EVENTS) - {"pfemResidual", "pfemHessian", "pfemPreconditioner", "pfemProduct"}
LAGGED = set(EVENTS)  # product without matrix, multigrid of an assembled one
MATRIX_FREE = set(EVENTS) - {"pfemPreconditioner"}


def log_of(folder, *settings):
    command = [sys.executable, "-m", "pfem_petsc", "rod_impact", "-o", str(folder), "--quiet", "--set", *settings]
    done = subprocess.run([*command, "--", "-log_view"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def count(text, event):
    """Of the calls in all stages."""
    return sum(int(n) for n in re.findall(rf"^{event}\s+(\d+) ", text, re.MULTILINE))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "linear", "events"),
    [
        ("central_differences", "auto", EXPLICIT),
        ("newmark", "gamg", LAGGED),
        ("newmark", "cg", MATRIX_FREE),
    ],
    ids=["explicit", "lagged", "matrix-free"],
)
def test_stages_and_events_are_named(tmp_path, integrator, linear, events):
    steps = 20
    settings = (f"time.integrator={integrator}", f"time.end={0.01 * steps}", "output.checkpoint_every=10")
    text = log_of(tmp_path, *settings, "output.fields_every=5", f"solver.linear={linear}")
    for stage in STAGES:
        assert re.search(rf"\d+:\s+{stage}: ", text), stage
    assert {event for event in EVENTS if count(text, event)} == events
    assert count(text, "pfemSolve") == steps
    assert count(text, "pfemLedger") == steps
    assert count(text, "pfemHistory") == steps + 1  # and the start
    assert count(text, "pfemSnapshot") == steps // 5 + 1
    assert count(text, "pfemCheckpoint") >= steps // 10


def test_nothing_is_laid_over_methods_unless_asked(tmp_path):
    from pfem_petsc import Case, Simulation

    simulation = Simulation(Case.load("rod_impact", overrides=["time.end=0.02"]), output=tmp_path, quiet=True)
    simulation.run()
    assert "_advance" not in vars(simulation)
    assert "forces" not in vars(simulation.model.bars)
