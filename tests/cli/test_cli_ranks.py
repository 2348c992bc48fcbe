"""Failures on several ranks: one message, one exit status, and nothing hangs."""

import pytest


def run_collectively(on_ranks, tmp_path, ranks, body, timeout=240.0, debug=False):
    """Run ``body``, lines of a function of ``comm``, as a verb is run by the command line."""
    script = tmp_path / "verb.py"
    lines = "\n".join(f"    {line}" for line in body.splitlines())
    script.write_text(
        "import sys\n"
        "from pfem_petsc.cli.main import collectively\n"
        "from pfem_petsc.errors import *\n"
        f"def verb(comm):\n{lines}\n"
        f"sys.exit(collectively(verb, {debug}))\n"
    )
    return on_ranks(ranks, script, timeout=timeout)


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["rod_impact", "--quite"], "unrecognized arguments: --quite"),
        (["rod_impct"], "did you mean 'rod_impact'?"),
        (["rod_impact", "--set", "time.end=0"], "rod_impact.toml: time.end = 0"),
        (["list", "extra"], "unrecognized arguments: extra"),
        (["info", "no_such_folder"], "no_such_folder"),
        (["rod_impact", "--set", "time.integrator=newmark", "--", "-pfem_ksp_type", "nonsense"], "options after --"),
        (["rod_impact", "--set", "time.integrator=newmark", "--", "-pfem_contact_pc_type", "nonsense"], "nonsense"),
    ],
)
def test_refusal_is_printed_once(on_ranks, tmp_path, ranks, words, text):
    done = on_ranks(ranks, "-m", "pfem_petsc", *words, cwd=tmp_path, timeout=240.0)
    assert done.returncode == 2
    assert done.stderr.count("error: ") == 1
    assert text in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failure", "status", "text"),
    [
        ("InputError('case.toml: key')", 2, "error: case.toml: key"),
        ("SimulationFailure('step 7: node 3')", 3, "error: step 7: node 3"),
        ("EarlyStop('at step 7')", 4, "stopped: at step 7"),
        ("MemoryError()", 3, "error: out of memory"),
        ("ZeroDivisionError('a\\nb')", 3, "internal error: ZeroDivisionError: a b; run with --debug to see where"),
        (
            "ModuleNotFoundError('No module named h5py', name='h5py')",
            2,
            "scripts/setup.sh",
        ),
        ("ModuleNotFoundError('No module named x', name='pfem_petsc.x')", 3, "internal error: ModuleNotFoundError"),
    ],
)
def test_failure_of_all_ranks(on_ranks, tmp_path, failure, status, text):
    done = run_collectively(on_ranks, tmp_path, 3, f"comm.Barrier()\nraise {failure}")
    assert done.returncode == status
    assert done.stderr.count(text) == 1
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_lowest_rank_speaks_for_all(on_ranks, tmp_path):
    done = run_collectively(
        on_ranks, tmp_path, 3, "raise InputError('first') if comm.rank == 0 else SimulationFailure(f'at {comm.rank}')"
    )
    assert done.returncode == 2
    assert "error: first" in done.stderr
    assert "error: at" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failing", "failure"), [(0, "SimulationFailure('disk full')"), (1, "RuntimeError('surprise')")]
)
def test_failure_of_one_rank_ends_the_others(on_ranks, tmp_path, failing, failure):
    """The other rank waits in a collective call that the failing one never makes."""
    body = f"if comm.rank == {failing}:\n    raise {failure}\ncomm.Barrier()\nreturn 0"
    done = run_collectively(on_ranks, tmp_path, 2, body)
    assert done.returncode == 3
    assert done.stderr.count(f"rank {failing}: ") == 1


@pytest.mark.slow
def test_rank_that_ends_early_does_not_hide_a_failure(on_ranks, tmp_path):
    body = "if comm.rank == 1:\n    raise SimulationFailure('late')\nreturn 0"
    done = run_collectively(on_ranks, tmp_path, 2, body)
    assert done.returncode == 3
    assert "rank 1: error: late" in done.stderr
