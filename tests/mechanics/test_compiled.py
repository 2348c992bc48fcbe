"""Loops that a process compiles are reported by the run; loops loaded from the cache are not."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import FunctionType

import numba
import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.mechanics.compiled import Compilation, _variant, code_digest
from pfem_petsc.mechanics.elements import MEASURES, batch_pulls, make_loops
from pfem_petsc.mechanics.materials import elastic, elastoplastic
from pfem_petsc.mechanics.materials.base import LAWS, damped, softened
from pfem_petsc.mechanics.rupture import breakable
from pfem_petsc.registry import choices, lookup

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
    with Compilation(lambda name, seconds: told.append(name), took.append):
        assert module().outer(3.0) == 7.0  # the inner one is compiled on the way: one time for both
        assert (told[0], len(took)) == ("outer", 1)
        assert 0.0 < took[0] < 60.0
        assert module().outer(3.0) == 7.0  # from disk
        assert module().inner(np.float32(1.0)) == 2.0  # for another type
        assert (told[0], len(took)) == ("outer", 2)
    module().outer(np.float32(1.0))
    assert len(took) == 2


def test_machine_code_from_disk_finds_what_it_refers_to(tmp_path):
    """Hashes of texts need a number of the process, a system of equations LAPACK, a random number its generator."""
    (tmp_path / "loops_of_others.py").write_text(
        "import numpy as np\n"
        "from pfem_petsc.mechanics.compiled import kernel\n"
        "@kernel\n"
        "def of_text(text):\n"
        "    return hash(text)\n"
        "@kernel\n"
        "def solved(a, b):\n"
        "    np.random.seed(1)\n"
        "    return np.linalg.solve(a, b) + 0.0 * np.sort(np.random.rand(2))\n"
        "@kernel\n"
        "def refused(x):\n"
        "    if x > 1.0:\n"
        "        raise ValueError('too large')\n"
        "    print('value', x)\n"
    )
    program = (
        "import numpy as np\n"
        "from loops_of_others import of_text, solved, refused\n"
        "assert of_text('a long text') == hash('a long text')\n"
        "print(solved(2.0 * np.eye(2), np.ones(2)))\n"
        "refused(0.5)\n"
        "try:\n"
        "    refused(2.0)\n"
        "except ValueError as error:\n"
        "    print(error)\n"
    )
    for _ in range(2):  # compiled, then loaded
        command = [sys.executable, "-c", program]
        said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        assert said == "[0.5 0.5]\nvalue 0.5\ntoo large\n"


def test_short_compilations_are_not_reported():
    """They count together; a report comes while the loop that makes them long is compiled."""
    told, took = [], []
    with Compilation(lambda *what: told.append(what), took.append, patience=60.0):
        numba.njit(lambda x: x + 1.0)(1.0)
    assert (told, len(took)) == ([], 1)
    with Compilation(lambda *what: told.append(what), took.append, patience=1e-6):
        numba.njit(lambda x: x + 1.0)(1.0)
        numba.njit(lambda x: x + 2.0)(1.0)
    assert ([name for name, _ in told], len(took)) == (["<lambda>"], 3)
    assert 0.0 < told[0][1] < 60.0


def test_a_long_compilation_is_told_while_it_lasts(monkeypatch):
    """With the time of all compilations so far, at intervals that grow up to a limit."""
    now, told, waits = [0.0], [], []

    class Timer:
        """Fires when the clock is moved."""

        def __init__(self, wait, function):
            waits.append(wait)
            self.fire = function
            self.daemon = False

        def start(self):
            pass

        cancel = join = start

    monkeypatch.setattr("pfem_petsc.mechanics.compiled.threading.Timer", Timer)
    monkeypatch.setattr("pfem_petsc.mechanics.compiled.time.perf_counter", lambda: now[0])
    watch = Compilation(lambda *what: told.append(what), lambda seconds: None, patience=2.0)

    def compile_for(seconds, name):
        loop = type("Dispatcher", (), {"py_func": type(name, (), {})})
        watch.on_start(type("Event", (), {"data": {"dispatcher": loop}}))
        end = now[0] + seconds
        while now[0] + waits[-1] < end:
            now[0] += waits[-1]
            watch._timer.fire()
        now[0] = end
        watch.on_end(None)

    compile_for(1.5, "first")
    now[0] += 100.0  # of steps, which do not count
    compile_for(60.0, "second")
    compile_for(0.5, "third")
    assert told == [("second", 2.0), ("second", 4.0), ("second", 8.0), ("second", 16.0), *told[4:]]
    assert told[4:] == [("second", 31.0), ("second", 46.0), ("second", 61.0)]


@pytest.mark.parametrize("patience, times", [(0.0, 1), (1e-4, 1), (600.0, 0)])
def test_run_says_what_it_compiles(tmp_path, monkeypatch, capsys, patience, times):
    monkeypatch.setattr("pfem_petsc.run.outputs._PATIENCE", patience)
    simulation = Simulation(Case.load("rod_impact", ["time.end=0.2"]), output=tmp_path / "it")

    def plus_one(x):
        return x + 1.0

    simulation.on_step(lambda step: numba.njit(plus_one)(1.0), every=5)
    simulation.run()
    said = capsys.readouterr().out
    found = re.findall(
        r"^compiling loops for this machine, which later runs load: plus_one, [\d.]+ s so far$", said, re.M
    )
    assert len(found) >= times and bool(found) == bool(times)
    assert "minute" not in said


def test_machine_code_is_never_older_than_what_a_loop_inlines(tmp_path, monkeypatch):
    """A function in a file of its own changes, or the code of a class that it uses: the loop gives the new value."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    names = ("inlined_by_a_test", "loop_of_a_test")
    (tmp_path / "loop_of_a_test.py").write_text(
        "from pfem_petsc.mechanics.compiled import kernel\nfrom inlined_by_a_test import law\n"
        "\n@kernel\ndef loop(x):\n    return law(x)\n"
    )

    def result(body: str, first: str = "one", second: str = "two") -> tuple[float, int]:
        source = "from typing import NamedTuple\nfrom pfem_petsc.mechanics.compiled import inlined\n"
        source += f"FACTOR = 2.0\n\nclass Pair(NamedTuple):\n    {first}: float\n    {second}: float\n"
        (tmp_path / "inlined_by_a_test.py").write_text(f"{source}\n@inlined\ndef law(x):\n    {body}\n")
        for name in names:
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        took = []
        with Compilation(lambda *what: None, took.append):
            value = importlib.import_module("loop_of_a_test").loop(3.0)
        return value, len(took)

    assert result("return FACTOR * x") == (6.0, 1)
    assert result("return FACTOR * x  # a comment changes nothing") == (6.0, 0)
    assert result("return FACTOR + x") == (5.0, 1)
    assert result("return Pair(x, FACTOR).one") == (3.0, 1)
    assert result("return Pair(x, FACTOR).one", "two", "one") == (2.0, 1)
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.parametrize("left", [0.0, 0.001, 0.5])
def test_damaged_machine_code_is_compiled_anew(module, tmp_path, left):
    assert module().outer(3.0) == 7.0
    (damaged,) = [path for path in tmp_path.rglob("*.nbc") if "outer" in path.name]
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: int(left * len(whole))])
    took = []
    with Compilation(lambda *what: None, took.append):
        assert module().outer(3.0) == 7.0
        assert module().outer(3.0) == 7.0
    # names in machine code count the functions of the process, so that lengths may differ by some digits
    assert len(took) == 1 and abs(damaged.stat().st_size - len(whole)) < 64


@pytest.mark.slow
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


@pytest.mark.slow
def test_every_process_finds_the_loop_of_batches_of_another():
    """Keys of loops that are made of other loops are the same in all processes: a start must not compile them anew."""
    program = (
        "from pfem_petsc.mechanics.elements import batch_pulls\n"
        "from pfem_petsc.mechanics.materials.elastic import LAW\n"
        "from pfem_petsc.mechanics.elements import engineering\n"
        "loop = batch_pulls(LAW, engineering).padded\n"
        "print(loop._cache.path((), loop.targetctx.codegen()), loop._cache.stamp)"
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
                loops = make_loops(variant, measure)
                names.append(_variant(loops.forces.py_func))
                longest = f"{batch_pulls(variant, measure).padded._cache.base}.{16 * 'x'}.nbc"
                assert len(Path(longest).name) < 220
    assert len(names) > 40 and len(set(names)) == len(names)


def test_loops_of_a_law_with_and_without_damping_have_their_own_files():
    """Otherwise each overwrites the machine code of the other, and both are compiled at each start."""
    laws = [elastic.LAW, damped(elastic.LAW), breakable(elastic.LAW), breakable(damped(elastic.LAW))]
    found = {make_loops(law, MEASURES["green"]).forces._cache.base for law in laws}
    assert len(found) == len(laws)


def test_each_loop_of_a_law_has_its_own_file():
    """Loops that one function makes would overwrite each other, and be compiled at each start."""
    loops = [loop for loop in vars(make_loops(elastic.LAW, MEASURES["green"])).values() if hasattr(loop, "_cache")]
    found = {loop._cache.base for loop in loops}
    assert len(found) == len(loops) > 5


OF_ONE_LAW = """
import sys
import numpy as np
from pfem_petsc.mechanics.elements import BarData, engineering, make_loops
from pfem_petsc.mechanics.materials import elastic, elastoplastic
from pfem_petsc.mechanics.runs import make_sweep

def energies(law, p):
    bars = np.array([[0, 1]], dtype=np.int32)
    x, far = np.array([[0.0, 0, 0], [1.5, 0, 0]]), np.array([1], dtype=np.uint32)
    sums = np.zeros(16)
    rest, heat, history = np.ones(1), np.empty((2, 0)), np.zeros((len(law.rows), 1))
    given = (far, make_sweep(bars, 0, 1, 1), rest, heat, np.empty(0), heat, p, 1.0, 0.0, history)
    data = BarData(np.uint64(0), np.uint64(1), bars, *given)
    make_loops(law, engineering).forces(x, data, True, np.zeros((2, 3)), sums)
    return float(sums.sum())

PARAMETERS = {"elastic": (elastic.LAW, (2.0,)), "elastoplastic": (elastoplastic.LAW, (2.0, 0.5, 0.0, 0.0, 0.5))}
print(*(energies(*PARAMETERS[name]) for name in sys.argv[1:]))
"""


@pytest.mark.slow
def test_machine_code_of_two_processes_does_not_mix_laws(tmp_path):
    """Each law is compiled by a process of its own, then a third one loads both."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    def run(*laws):
        command = [sys.executable, "-c", OF_ONE_LAW, *laws]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return [float(word) for word in done.stdout.split()]

    assert run("elastic") == [pytest.approx(0.25)]
    # yields at 0.25, then 0.5 along the rest of the strain
    assert run("elastoplastic") == [pytest.approx(0.0625 + 0.125)]
    assert run("elastic", "elastoplastic") == [pytest.approx(0.25), pytest.approx(0.1875)]
    assert run("elastoplastic", "elastic") == [pytest.approx(0.1875), pytest.approx(0.25)]


def closures(function, found):
    """Collect a function and all functions in its closure."""
    function = getattr(function, "py_func", function)
    if isinstance(function, FunctionType) and function not in found:
        found.add(function)
        for cell in function.__closure__ or ():
            closures(cell.cell_contents, found)


def test_functions_of_one_name_have_the_same_code():
    """Machine code of several processes is told apart by names of functions."""
    found = set()
    for law in (elastic.LAW, elastoplastic.LAW, softened(elastic.LAW), softened(elastoplastic.LAW)):
        for measure in MEASURES.values():
            loops = make_loops(law, measure)
            made = [value for value in vars(loops).values() if callable(value)]
            for loop in (*made, *vars(batch_pulls(law, measure)).values()):
                closures(loop, found)
    digests = {}
    for function in found:
        name = function.__module__, function.__qualname__
        assert digests.setdefault(name, code_digest(function)) == code_digest(function), name
    assert len(digests) > 50
