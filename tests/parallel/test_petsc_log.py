"""``-log_view`` shows a run's stages and events by name, and a run without it has none of them."""

import re
import subprocess
import sys

import numpy as np
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


def operations(text, event):
    """Of the calls in all stages."""
    return sum(float(n) for n in re.findall(rf"^{event}\s+\d+ \S+ \S+\s+\S+ (\S+) ", text, re.MULTILINE))


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
    bars, nodes = 20, 21
    assert operations(text, "pfemForces") == pytest.approx(28 * bars * count(text, "pfemForces"), rel=0.01)
    balance = 5 * nodes * steps if events == EXPLICIT else 0
    # nested events count in both
    assert operations(text, "pfemSolve") >= balance
    assert operations(text, "pfemProduct") == pytest.approx(
        (27 * bars + 3 * nodes) * count(text, "pfemProduct"), rel=0.01
    )


@pytest.mark.parallel
def test_messages_of_ghosts_are_counted_with_their_bytes(comm):
    from pfem_petsc import Case
    from pfem_petsc.parallel.petsc_log import _Counters
    from pfem_petsc.stepping.model import Model

    mesh = Model(Case.load("rod_impact"), comm).mesh
    sent, received, leaving, arriving = mesh.traffic(np.empty((mesh.n_local, 3)))
    assert arriving == 24 * (mesh.n_local - mesh.n_owned)
    assert comm.allreduce(leaving) == comm.allreduce(arriving)
    owned = comm.allgather(set(mesh.node_ids[: mesh.n_owned].tolist()))
    ghosts = set(mesh.node_ids[mesh.n_owned :].tolist())
    assert received == sum(bool(ghosts & other) for other in owned)
    assert comm.allreduce(sent) == comm.allreduce(received)
    assert received > 0 or comm.size == 1
    counters = _Counters()
    before = [place.value for place in counters._places]
    counters.add((sent, received, leaving, arriving))
    after = [place.value for place in counters._places]
    assert np.subtract(after, before).tolist() in ([], [sent, received, leaving, arriving])


def test_nothing_is_laid_over_methods_unless_asked(tmp_path):
    from pfem_petsc import Case, Simulation

    simulation = Simulation(Case.load("rod_impact", overrides=["time.end=0.02"]), output=tmp_path, quiet=True)
    simulation.run()
    assert "_advance" not in vars(simulation)
    assert "forces" not in vars(simulation.model.bars)
