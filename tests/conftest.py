"""Tests on one rank and on several: ``mpirun -n 3 python -m pytest`` runs those marked ``parallel``.

All ranks run the same tests in the same order and agree on the outcome of each phase of a test (set-up, call,
tear-down), so a failure on one rank is a failure on all, with that rank's report. A rank that waits too long for the
others, for example because an exception ended a collective call on one of them, reports this and ends the run. Only
rank 0 prints.

Of the slow tests a part is run, another one after each commit (``--part``), of tests with many sets of parameters some,
and those marked ``thorough`` are left out; ``--all-sets`` runs everything.
"""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.launch import OF_A_LAUNCH, PARTS, environment, part_of_commit, refuse_repeated_names, thinned
from hypothesis import settings

if "PYTEST_XDIST_WORKER" in os.environ:
    for _name in [name for name in os.environ if name.startswith(OF_A_LAUNCH)]:
        del os.environ[_name]

# In the background and under nohup this process ignores signals, and so would the runs that tests stop with signals.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

from mpi4py import MPI  # noqa: E402

WORLD = MPI.COMM_WORLD
AGREEMENT = WORLD.Dup() if WORLD.size > 1 else None
PASSED, SKIPPED, FAILED = range(3)
OUTCOME = {"passed": PASSED, "skipped": SKIPPED, "failed": FAILED}
# Seconds that a rank waits for the others after a phase that passed, and after one that failed.
PATIENCE = {PASSED: 1200.0, SKIPPED: 300.0, FAILED: 120.0}

# The same examples on every rank and in every run; compiled kernels make the first example slow.
settings.register_profile("ranks", derandomize=True, deadline=None, database=None)
settings.load_profile("ranks")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--all-sets",
        action="store_true",
        help="all sets of parameters of each test, all slow tests, and the tests marked thorough",
    )
    parser.addoption(
        "--part",
        type=int,
        choices=range(PARTS),
        help="part of the slow tests that is run; by default another one after each commit",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    refuse_repeated_names(Path(__file__).parent)
    if config.option.part is None:
        config.option.part = part_of_commit(Path(__file__).parent)
    if AGREEMENT is not None:
        # A folder of its own for each rank: pytest's numbered ones are claimed by several at once.
        config.option.basetemp = tempfile.mkdtemp(prefix=f"pytest-rank{WORLD.rank}-")
        # On SIGTERM, for example at a time limit, the results so far are still reported.
        signal.signal(signal.SIGTERM, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    if WORLD.rank > 0:
        terminal = session.config.pluginmanager.getplugin("terminalreporter")
        terminal._tw._file = open(os.devnull, "w")  # noqa: SIM115 - open for as long as the process lives


def pytest_report_header(config: pytest.Config) -> str:
    which = "all tests" if config.option.all_sets else f"slow tests: those of --part {config.option.part}"
    return f"ranks: {WORLD.size}, {which}"


def pytest_unconfigure(config: pytest.Config) -> None:
    if AGREEMENT is not None:
        shutil.rmtree(config.option.basetemp, ignore_errors=True)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept = items
    if AGREEMENT is not None:
        kept = [item for item in items if item.get_closest_marker("parallel") is not None]
    # tests that are asked for by name are run, all of them
    if not config.option.all_sets and not any("::" in word for word in config.args):
        kept = thinned(kept, WORLD.size, config.option.part)
    chosen = set(kept)
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = kept


def pytest_collection_finish(session: pytest.Session) -> None:
    if AGREEMENT is None:
        return
    names = [item.nodeid for item in session.items]
    wait_for_all("the collection of tests", PASSED, "")
    everywhere = AGREEMENT.allgather((names, session.testsfailed))
    if any(other != names for other, _ in everywhere):
        pytest.exit("the ranks found different tests to run", returncode=1)
    if any(failed for _, failed in everywhere) and not session.testsfailed:
        pytest.exit("another rank could not collect the tests", returncode=1)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    if AGREEMENT is None:
        return report
    mine = OUTCOME[report.outcome]
    worst = wait_for_all(f"{item.nodeid} ({report.when})", mine, report.longreprtext)
    if worst == FAILED:
        texts = AGREEMENT.allgather(report.longreprtext if mine == FAILED else None)
        failed = [rank for rank, text in enumerate(texts) if text is not None]
        if mine != FAILED or failed != list(range(WORLD.size)):
            report.outcome = "failed"
            report.longrepr = "\n".join(f"--- rank {rank} of {WORLD.size}\n{texts[rank]}" for rank in failed)
    elif worst == SKIPPED and mine == PASSED and report.when == "setup":
        # Skipped here too: the other ranks would be missing from its collective calls.
        report.outcome = "skipped"
        report.longrepr = (str(item.path), 0, "Skipped: on another rank")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    result = yield
    # PETSc destroys collectively, Python collects whenever it likes: bring the ranks in step between tests.
    gc.collect()
    # What is alive now is not looked at again: most of it is Numba's, and each look, of which every implicit stepper
    # takes one, would take as long as a test.
    gc.freeze()
    petsc4py = sys.modules.get("petsc4py.PETSc")
    if AGREEMENT is not None and petsc4py is not None and hasattr(petsc4py, "garbage_cleanup"):
        petsc4py.garbage_cleanup()
    return result


def wait_for_all(what: str, outcome: int, text: str) -> int:
    """Agree on the worst outcome of a phase over all ranks, or end the run if a rank does not arrive."""
    worst = bytearray([outcome])
    request = AGREEMENT.Iallreduce(MPI.IN_PLACE, [worst, MPI.UNSIGNED_CHAR], op=MPI.MAX)
    start = time.monotonic()
    while not request.Test():
        waited = time.monotonic() - start
        if waited > PATIENCE[outcome]:
            print(
                f"\nrank {WORLD.rank} of {WORLD.size}: after {what} the other ranks were not there in {waited:.0f} s:"
                f" they may be waiting for this one in a collective call.\n{text}",
                file=sys.stderr,
                flush=True,
            )
            AGREEMENT.Abort(1)
        time.sleep(min(0.01, waited / 10))
    return worst[0]


@pytest.fixture
def own_registry(monkeypatch):
    """A registry of plugins of the test's own."""
    from pfem_petsc import registry

    monkeypatch.setattr(registry, "_plugins", {package: {} for package in registry.KINDS})
    monkeypatch.setattr(registry, "_sources", {})
    yield
    for package, modules in registry._plugins.items():
        for name in modules:
            sys.modules.pop(f"{package}.{name}", None)


@pytest.fixture
def comm() -> MPI.Intracomm:
    """All ranks of the run."""
    return WORLD


@pytest.fixture
def shared_tmp_path() -> Iterator[Path]:
    """One temporary folder for all ranks, removed after the test."""
    folder = WORLD.bcast(tempfile.mkdtemp(prefix="pfem-test-") if WORLD.rank == 0 else None)
    yield Path(folder)
    WORLD.Barrier()
    if WORLD.rank == 0:
        shutil.rmtree(folder)


@pytest.fixture
def on_ranks() -> Callable[..., subprocess.CompletedProcess]:
    """Run Python on several ranks in separate processes: ``on_ranks(2, "-m", "pfem_petsc", "case.toml", cwd=...)``.

    The result has ``returncode``, ``stdout`` and ``stderr``; ``timeout`` [s] ends all ranks with an exception.
    """

    def run(ranks: int, *arguments: str | Path, timeout: float = 400.0, **options) -> subprocess.CompletedProcess:
        command = ["mpirun", "-n", str(ranks), sys.executable, *map(str, arguments)]
        # timeout(1) sends SIGTERM to mpirun, which ends its ranks; a killed mpirun would leave them running.
        command = ["timeout", "--kill-after=10", str(timeout), *command]
        done = subprocess.run(command, env=environment(), capture_output=True, text=True, **options)
        if done.returncode in (124, 137):
            raise TimeoutError(f"{' '.join(command)}\n{done.stdout}\n{done.stderr}")
        return done

    return run


@pytest.fixture
def chance() -> np.random.Generator:
    """Random numbers that differ from run to run; the seed is printed with a failure, and taken from TEST_SEED."""
    seed = int(os.environ.get("TEST_SEED") or np.random.SeedSequence().entropy % 10**9)
    print(f"TEST_SEED={seed}")
    return np.random.default_rng(seed)
