"""Loops that a process compiles are reported by the run; loops loaded from the cache are not."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.case.materials import LAWS
from pfem_petsc.integrators.central_differences import Scheme
from pfem_petsc.mechanics import strips
from pfem_petsc.mechanics.compiled import Compilation, _variant, code_digest
from pfem_petsc.mechanics.kernels import make_kernels
from pfem_petsc.mechanics.materials import elastic
from pfem_petsc.mechanics.materials._softening import softened
from pfem_petsc.mechanics.materials._stiffness_damping import damped
from pfem_petsc.mechanics.rupture import breakable
from pfem_petsc.mechanics.strain import MEASURES, engineering
from pfem_petsc.registry import choices, lookup
from pfem_petsc.stepping.explicit import ExplicitStepper
from pfem_petsc.stepping.fused_loop import make_fused_loop

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
    with Compilation(told.append, took.append):
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
    assert said.count("compiling loops for this machine (once") == 1


def test_machine_code_is_never_older_than_what_a_loop_inlines(tmp_path, monkeypatch):
    """A function in a file of its own changes: the loop that compiles it in gives the new value."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    names = ("inlined_by_a_test", "loop_of_a_test")
    (tmp_path / "loop_of_a_test.py").write_text(
        "from pfem_petsc.mechanics.compiled import kernel\nfrom inlined_by_a_test import law\n"
        "\n@kernel\ndef loop(x):\n    return law(x)\n"
    )

    def result(body: str) -> tuple[float, int]:
        source = f"from pfem_petsc.mechanics.compiled import inlined\nFACTOR = 2.0\n@inlined\ndef law(x):\n    {body}\n"
        (tmp_path / "inlined_by_a_test.py").write_text(source)
        for name in names:
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        took = []
        with Compilation(lambda name: None, took.append):
            value = importlib.import_module("loop_of_a_test").loop(3.0)
        return value, len(took)

    assert result("return FACTOR * x") == (6.0, 1)
    assert result("return FACTOR * x  # a comment changes nothing") == (6.0, 0)
    assert result("return FACTOR + x") == (5.0, 1)
    for name in names:
        sys.modules.pop(name, None)


def test_code_that_a_class_generates_is_part_of_the_digest(monkeypatch):
    before = code_digest(make_kernels(elastic.LAW, engineering).forces.py_func)
    assert before == code_digest(make_kernels(elastic.LAW, engineering).forces.py_func)
    monkeypatch.setattr(strips._Strip, "store_nodes", lambda self, vectors, pointer, node: None)
    assert code_digest(make_kernels(elastic.LAW, engineering).forces.py_func) != before


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_damaged_machine_code_is_compiled_anew(module, tmp_path, suffix):
    assert module().outer(3.0) == 7.0
    damaged = [path for path in tmp_path.rglob(f"*.{suffix}") if "outer" in path.name]
    assert damaged
    for path in damaged:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert module().outer(3.0) == 7.0


def test_every_process_finds_the_machine_code_of_another():
    """The digest of loops does not depend on the order of sets, which is another in every process."""
    program = (
        "from pfem_petsc.contact import frames, projection\n"
        "from pfem_petsc.mechanics.compiled import code_digest\n"
        "print(code_digest(frames._build), code_digest(projection.project))"
    )
    digests = set()
    for seed in ("1", "2", "3"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", program]
        digests.add(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    assert len(digests) == 1


def test_every_process_finds_the_fused_loop_of_another():
    """Keys of loops that are made of other loops are the same in all processes: a start must not compile them anew."""
    program = (
        "from pfem_petsc.integrators.central_differences import Scheme\n"
        "from pfem_petsc.mechanics.kernels import make_kernels\n"
        "from pfem_petsc.mechanics.materials.elastic import LAW\n"
        "from pfem_petsc.mechanics.strain import engineering\n"
        "from pfem_petsc.stepping.fused_loop import make_fused_loop\n"
        "kernels = make_kernels(LAW, engineering)\n"
        "parts = kernels.sweep_part, kernels.sum_energies, kernels.clear_energies, kernels.work_rows\n"
        "loop = make_fused_loop(*parts, *Scheme.loops)\n"
        "print(loop._cache._index_key((), loop.targetctx.codegen()), loop._cache._cache_file._source_stamp)"
    )
    keys = set()
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", program]
        keys.add(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    assert len(keys) == 1


def test_loops_of_all_laws_have_names_of_their_own():
    """Of each law and strain measure, softened by temperature or not, and short enough for any file system."""
    names = []
    for name in choices(LAWS):
        law = lookup(LAWS, name, "").LAW
        for variant in (law, softened(law)) if law.softening is not None else (law,):
            for measure in MEASURES.values():
                kernels = make_kernels(variant, measure)
                names.append(_variant(kernels.forces.py_func))
                fused = make_fused_loop(
                    kernels.sweep_part, kernels.sum_energies, kernels.clear_energies, kernels.work_rows, *Scheme.loops
                )
                longest = fused._cache._cache_file._data_path("x")
                assert len(Path(longest).name) < 220
    assert len(names) > 40 and len(set(names)) == len(names)


def test_loops_of_a_law_with_and_without_damping_have_their_own_files():
    """Otherwise each overwrites the machine code of the other, and both are compiled at each start."""
    laws = [elastic.LAW, damped(elastic.LAW), breakable(elastic.LAW), breakable(damped(elastic.LAW))]
    found = {make_kernels(law, MEASURES["green"]).forces._cache._cache_file._index_path for law in laws}
    assert len(found) == len(laws)
