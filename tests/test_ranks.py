"""The test runner itself: a failure on one rank is detected and reported, and nothing hangs."""

from __future__ import annotations

from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name("conftest.py")
HEADER = "import pytest\nfrom mpi4py import MPI\nrank = MPI.COMM_WORLD.rank\n"


@pytest.fixture
def outcome(tmp_path, on_ranks):
    """Run the lines of a test on 2 ranks: exit status and output."""

    def run(*lines: str) -> tuple[int, str]:
        (tmp_path / "conftest.py").write_text(CONFTEST.read_text().replace("FAILED: 120.0", "FAILED: 1.0"))
        (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = parallel\n")
        (tmp_path / "test_it.py").write_text(HEADER + "\n".join(lines) + "\n")
        options = ["-p", "no:cacheprovider", "-o", f"pythonpath={CONFTEST.parent}"]
        done = on_ranks(2, "-m", "pytest", "--color=no", *options, cwd=tmp_path, timeout=300)
        return done.returncode, done.stdout + done.stderr

    return run


@pytest.mark.slow
def test_failure_on_one_rank_fails_the_run_with_its_report(outcome):
    status, output = outcome("@pytest.mark.parallel", "def test_a():", "    assert rank != 1, 'rank one is unwell'")
    assert status != 0
    assert "--- rank 1 of 2" in output
    assert "rank one is unwell" in output
    assert output.count("1 failed in") == 1


@pytest.mark.slow
def test_rank_that_leaves_a_collective_call_early_ends_the_run(outcome):
    status, output = outcome(
        "@pytest.mark.parallel",
        "def test_a():",
        "    assert rank == 0, 'left early'",
        "    MPI.COMM_WORLD.Barrier()",
    )
    assert status != 0
    assert "rank 1 of 2: after test_it.py::test_a (call)" in output
    assert "left early" in output


@pytest.mark.slow
def test_serial_tests_are_left_out_and_folders_agree_as_promised(outcome):
    status, output = outcome(
        "def test_serial():",
        "    raise AssertionError",
        "@pytest.mark.parallel",
        "def test_folders(comm, tmp_path, shared_tmp_path):",
        "    assert len(set(comm.allgather(str(tmp_path)))) == comm.size == 2",
        "    assert len(set(comm.allgather(str(shared_tmp_path)))) == 1",
        "    (shared_tmp_path / str(rank)).touch()",
        "    comm.Barrier()",
        "    assert len(list(shared_tmp_path.iterdir())) == 2",
    )
    assert status == 0
    assert "1 passed, 1 deselected in" in output
    assert output.count("test session starts") == 1
