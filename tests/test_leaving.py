"""The end of the program."""

import os
import subprocess
import sys

import h5py
import pytest

from pfem_petsc import signals

PLUGIN = """
import atexit

atexit.register(print, "the last words")


def generate(parameters):
    raise NotImplementedError
"""


@pytest.mark.slow
@pytest.mark.parametrize(("case", "status"), [("rod_impact", 0), ("nothing", 2)])
def test_all_that_is_due_at_exit_is_done(case, status, tmp_path):
    """What others have registered, then the log of PETSc; into a pipe, which is written when the program ends."""
    (tmp_path / "last.py").write_text(PLUGIN)
    command = [sys.executable, "-m", "pfem_petsc", case, "--quiet", "-o", "out", "--plugin", "last.py"]
    done = subprocess.run([*command, "--", "-log_view"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    if status == 0:
        assert done.stdout.index("the last words") < done.stdout.index("PETSc Performance Summary")


@pytest.mark.slow
def test_process_does_not_leave_early_after_a_failure_or_with_open_files(tmp_path, monkeypatch):
    left = []
    monkeypatch.setattr(os, "_exit", left.append)
    monkeypatch.setattr(sys, "modules", {"h5py": h5py})
    end = signals.Leaving()
    for end.status in (None, 2):
        end.leave()
    end.status = 0
    with h5py.File(tmp_path / "open.h5", "w"):
        end.leave()
    assert left == []
    if h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE) == 0:  # of other tests
        end.leave()
        assert left == [0]
