"""Loops that a process compiles are reported by the run; loops loaded from disk are not, and are never stale."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.mechanics import compiled
from pfem_petsc.mechanics.chunk_laws import law_loops
from pfem_petsc.mechanics.compiled import Compilation, count_compiled, kernel
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


def run_python(program, *words, folder=None, **environment):
    """Return what a process prints, whose machine code is kept in a folder of its own, and its warnings."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{compiled._PACKAGE.parent}", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr


OF_ONE_LAW = """
import sys
import numpy as np
from pfem_petsc.mechanics.chunk_laws import densities_row, evaluate
from pfem_petsc.mechanics.materials import elastic, elastoplastic

PARAMETERS = {"elastic": (elastic.LAW, (2.0,)), "elastoplastic": (elastoplastic.LAW, (2.0, 0.5, 0.0, 0.0, 0.5))}
for law, p in map(PARAMETERS.get, sys.argv[1:]):
    found = evaluate(law, p, 0.5, 0.0, np.zeros((len(law.rows), 1)))
    print(found[densities_row(law) :].sum())
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


def test_compiling_is_counted_and_loading_is_not(module):
    before = count_compiled()
    assert module().outer(3.0) == 7.0
    assert count_compiled() == before + 2
    assert module().outer(3.0) == 7.0  # from disk
    assert count_compiled() == before + 2
    assert module().inner(np.float32(1.0)) == 2.0  # for another type
    assert count_compiled() == before + 3


def test_short_compilations_are_not_reported():
    """They count together; a long one is told with the time of all so far, at intervals that grow up to a limit."""
    told, took = [], []
    watch = Compilation(lambda *what: told.append(what), took.append, patience=2.0)
    for name, seconds in (("first", 1.5), ("second", 60.0), ("third", 0.5)):
        for _ in range(int(seconds / 0.5)):
            watch.look(name, 0.5)
    times = [2.0, 4.0, 8.0, 16.0, 31.0, 46.0, 61.0]
    assert told == [("second", time) for time in times]
    assert sum(took) == 62.0


@pytest.mark.parametrize("patience", [0.0, 600.0])
def test_run_says_what_it_compiles(tmp_path, monkeypatch, capsys, patience):
    monkeypatch.setattr("pfem_petsc.run.outputs._PATIENCE", patience)
    monkeypatch.setattr(compiled, "LOOK_EVERY", 0.005)
    monkeypatch.setattr(compiled, "_FOLDER", None)
    case = Case.load("rod_impact", ["time.end=0.2", "time.integrator=newmark"])
    simulation = Simulation(case, output=tmp_path / "it")

    def plus_one(x):
        return x + 1.0

    simulation.on_step(lambda step: kernel(plus_one)(1.0), every=5)
    simulation.run()
    said = capsys.readouterr().out
    found = re.findall(r"^compiling loops for this machine, which later runs load: \w+, [\d.]+ s so far$", said, re.M)
    assert bool(found) == (patience == 0.0)
    assert "minute" not in said


@pytest.mark.slow
def test_the_folder_depends_on_all_sources(tmp_path):
    """A changed file of the package leads to another folder, so that no loop inlines what a function was."""
    copy = tmp_path / "pfem_petsc"
    shutil.copytree(compiled._PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    program = "from pfem_petsc.mechanics import compiled\nprint(compiled._FOLDER)"

    def folder():
        (path,), _ = run_python(program, folder=tmp_path, PYTHONPATH=str(tmp_path))
        assert Path(path).is_dir()
        return Path(path)

    first = folder()
    assert first == folder() and first.parent == copy / "__pycache__"
    constants = copy / "tolerances.py"
    constants.write_text(constants.read_text() + "\n# another text\n")
    second = folder()
    assert second != first and second.parent == first.parent
    for k in range(compiled._KEPT):  # those of versions that are used no more are removed
        old = copy / "__pycache__" / f"pfem_petsc-{k}"
        old.mkdir()
        os.utime(old, (k, k))
    os.utime(first, (1000, 1000))
    constants.write_text(constants.read_text() + "\n# a third one\n")
    third = folder()
    left = set(third.parent.glob("pfem_petsc-*"))
    assert {first, second, third} <= left and len(left) == compiled._KEPT


@pytest.mark.slow
def test_machine_code_is_kept_where_it_can_be(tmp_path):
    """In the package, in the folder for it of the user, or nowhere, which is told once; a folder that the user gives
    comes first, and Numba's own choice for other programs is not changed."""
    copy = tmp_path / "pfem_petsc"
    shutil.copytree(compiled._PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "__pycache__").write_text("no folder\n")
    program = "import numba\nfrom pfem_petsc.mechanics import chunk_laws, compiled\n"
    program += "print(compiled._FOLDER, repr(numba.config.CACHE_DIR))"
    own, given = tmp_path / "own", tmp_path / "given"
    settings = {"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_CACHE_DIR": ""}
    (folder, theirs), told = run_python(program, folder=tmp_path, **settings, XDG_CACHE_HOME=str(own))
    assert Path(folder).parent == own and (theirs, told) == ("''", "")
    (folder, theirs), told = run_python(program, folder=tmp_path, **settings | {"NUMBA_CACHE_DIR": str(given)})
    assert Path(folder).parent == given and (theirs, told) == (repr(str(given)), "")
    (folder, _), told = run_python(program, folder=tmp_path, **settings, XDG_CACHE_HOME=str(copy / "__pycache__"))
    assert folder == "None" and told.count("compiled code cannot be cached") == 1
    of_law = OF_ONE_LAW + "from pfem_petsc.mechanics.compiled import count_compiled\nprint(count_compiled())"
    for _ in range(2):
        (value, count), _ = run_python(
            of_law, "elastic", folder=tmp_path, **settings, XDG_CACHE_HOME=str(copy / "__pycache__")
        )
        assert (float(value), int(count)) == (0.25, 1)


LAW_OF_A_USER = """
import sys
from numba.extending import register_jitable
from pfem_petsc import registry
from pfem_petsc.mechanics.chunk_laws import STRESS, evaluate
from pfem_petsc.mechanics.compiled import count_compiled
from pfem_petsc.mechanics.materials.base import LAWS
import numpy as np

registry.add_plugin(sys.argv[1])
law = registry.lookup(LAWS, "of_a_user", "").LAW
print(evaluate(law, (2.0,), 0.5, 0.0, np.zeros((0, 1)))[STRESS, 0], count_compiled())
"""


@pytest.mark.slow
def test_a_law_of_a_user_is_compiled_anew_when_its_file_changes(tmp_path):
    path, unique = tmp_path / "of_a_user.py", uuid4()  # no earlier run has compiled this file

    def found(factor):
        path.write_text(
            f"# {unique}\nfrom numba.extending import register_jitable\nfrom .base import Law\n\nFACTOR = "
            f"{factor}\n\n\n@register_jitable\ndef response(strain, rate, step, temperature, p, q):\n"
            "    return FACTOR * p[0] * strain, FACTOR * p[0], (), (0.0,)\n\n\n"
            'LAW = Law(response, energies=("elastic_energy",))\n'
        )
        (stress, count), _ = run_python(LAW_OF_A_USER, path)
        return float(stress), int(count)

    first = found(3.0)
    assert first == (3.0, 1)
    assert found(3.0) == (3.0, 0)
    assert found(5.0) == (5.0, 1)
    assert found(3.0) == (3.0, 0)  # kept beside the other


def loops_of(law):
    return [loop for loop in vars(law_loops(law, 20 * (0,))).values() if loop is not None]


def test_loops_of_all_laws_have_names_of_their_own():
    """Of each law, softened by temperature or not, damped or not, breakable or not; they are the names of files, which
    ranks that compile different laws at once must not share."""
    names = []
    for name in choices(LAWS):
        law = lookup(LAWS, name, "").LAW
        for variant in (law, damped(law), *((softened(law),) if law.softening is not None else ())):
            names += [loop.py_func.__qualname__ for one in (variant, breakable(variant)) for loop in loops_of(one)]
    assert len(names) > 100 and len(set(names)) == len(names)
