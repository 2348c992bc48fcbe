"""Loops that are compiled by a process are noticed, those that are loaded are not, and a run says so."""

import sys

import numba
import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.mechanics.compiled import Compilation
from pfem_petsc.stepping.explicit import ExplicitStepper

MODULE = """
from pfem_petsc.mechanics.compiled import kernel

@kernel
def inner(x):
    return 2.0 * x

@kernel
def outer(x):
    return inner(x) + 1.0
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Imports the loops anew, as another process would."""
    (tmp_path / "loops_of_a_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)

    def again():
        sys.modules.pop("loops_of_a_test", None)
        import loops_of_a_test

        return loops_of_a_test

    yield again
    sys.modules.pop("loops_of_a_test", None)


def test_compiling_is_noticed_once_and_loading_is_not(module):
    told, took = [], []
    with Compilation(lambda: told.append(1), took.append):
        assert module().outer(3.0) == 7.0  # the inner one is compiled on the way: one time for both
        assert (len(told), len(took)) == (1, 1)
        assert 0.0 < took[0] < 60.0
        assert module().outer(3.0) == 7.0  # from disk
        assert module().inner(np.float32(1.0)) == 2.0  # for another type
        assert (len(told), len(took)) == (1, 2)
    module().outer(np.float32(1.0))
    assert len(took) == 2


def test_run_says_that_it_compiles(tmp_path, monkeypatch, capsys):
    step = ExplicitStepper.step

    def compiling(self):
        if self.state.step == 5:
            numba.njit(lambda x: x + 1.0)(1.0)
        step(self)

    monkeypatch.setattr(ExplicitStepper, "step", compiling)
    Simulation(Case.load("rod_impact", ["time.end=0.2"]), output=tmp_path / "it").run()
    said = capsys.readouterr().out
    assert said.count("compiling loops for this machine, once") == 1
