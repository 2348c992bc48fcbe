"""The check of the machine, and completion in shells."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from shutil import which

import pytest

import pfem_petsc
from pfem_petsc import InputError
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli import machine as environment
from pfem_petsc.cli.machine import Finding, inspect_environment, report
from pfem_petsc.cli.main import HOMES, exit_message, main, on_first_rank

HERE = {
    "version('": "99.0",
    "Get_library_version": "Open MPI v4.1.4",
    "hasExternalPackage": json.dumps(
        {"version": "3.18.5", "scalar": "float64", "index": "int32", "mumps": True, "hypre": True, "ptscotch": False}
    ),
    "COMM_WORLD.rank": 'found [2, 2, true, "1.10.8", "/usr/h5py.py"]',
    "require_rendering": "vtkOSOpenGLRenderWindow",
}


def machine(**changes):
    """A machine that has everything, but for changes: part of a probe, and its status and output."""

    def run(command):
        text = command[-1]
        for part, answer in changes.items():
            if part in text:
                return answer
        return 0, next(answer for part, answer in HERE.items() if part in text)

    return run


@pytest.fixture(autouse=True)
def mpirun(monkeypatch):
    monkeypatch.setattr(environment.shutil, "which", lambda name: f"/usr/bin/{name}")


def states(found: list[Finding]) -> dict[str, str]:
    return {each.name: each.state for each in found if each.state != "ok"}


def test_what_is_here_is_told():
    found = inspect_environment(machine())
    assert states(found) == {"petsc: ptscotch": "optional"}
    lines = report(found)
    assert any(line.split() == ["ok", "petsc4py", "PETSc", "3.18.5,", "float64,", "int32", "indices"] for line in lines)
    assert any("h5py is parallel (HDF5 1.10.8)" in line for line in lines)


@pytest.mark.parametrize(
    ("part", "answer", "name", "text", "remedy"),
    [
        (
            "import numba",
            (1, "ImportError: no numba"),
            "numba",
            "ImportError: no numba (compiled loops)",
            "pip install",
        ),
        ("import pydantic", (0, "1.10"), "pydantic", "1.10 is too old: 2 or newer", '"pydantic>=2"'),
        ("Get_library", (-11, "Segmentation fault"), "mpi4py", "Segmentation fault", "python3-mpi4py"),
        (
            "hasExternalPackage",
            (1, "ValueError: numpy.dtype size changed, may indicate binary incompatibility"),
            "petsc4py",
            "numpy.dtype size changed",
            'pip install "numpy<2"',
        ),
        (
            "COMM_WORLD.rank",
            (0, 'found [2, 1, true, "1.10", "/usr/h5py.py"]'),
            "2 ranks",
            "different MPI installations",
            "petsc4py-real",
        ),
        (
            "COMM_WORLD.rank",
            (0, 'found [2, 2, false, "1.14", "/usr/h5py.py"]'),
            "2 ranks",
            "h5py (HDF5 1.14) in /usr/h5py.py is not the parallel build",
            "apt-get install --no-install-recommends python3-h5py-mpi",
        ),
        (
            "COMM_WORLD.rank",
            (0, f'found [2, 2, false, "1.14", "{sys.prefix}/lib/h5py.py"]'),
            "2 ranks",
            "is not the parallel build",
            "-m pip uninstall --yes h5py && apt-get",
        ),
        (
            "COMM_WORLD.rank",
            (1, "mpirun has detected an attempt to run as root.\nWe reiterate our advice against doing so"),
            "2 ranks",
            "Open MPI refuses to run as root",
            "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1",
        ),
        ("COMM_WORLD.rank", (1, "ORTE was unable"), "2 ranks", "mpirun -n 2 fails: ORTE was unable", "openmpi-bin"),
        (
            "hasExternalPackage",
            (0, HERE["hasExternalPackage"].replace("float64", "complex128")),
            "petsc4py",
            "complex128, int32 indices: a real, double build is needed",
            "petsc4py-real",
        ),
        (
            "hasExternalPackage",
            (0, HERE["hasExternalPackage"].replace("3.18.5", "3.9.1")),
            "petsc4py",
            "3.18 or newer is needed",
            "petsc4py-real",
        ),
    ],
    ids=[
        "import",
        "old",
        "crash",
        "NumPy 2",
        "two MPIs",
        "serial h5py",
        "h5py that hides another",
        "root",
        "mpirun",
        "complex",
        "old PETSc",
    ],
)
def test_what_is_missing_has_its_remedy(monkeypatch, capsys, part, answer, name, text, remedy):
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    found = inspect_environment(machine(**{part: answer}))
    (missing,) = (each for each in found if each.state == "missing")
    assert missing.name == name and text in missing.text and remedy in missing.remedy
    assert missing.remedy in "\n".join(report(found)).partition("to install what is missing:")[2]
    monkeypatch.setattr(environment, "_run", machine(**{part: answer}))
    assert main(["check", "--env"]) == 2
    assert f"check --env: missing: {name}; the list above" in capsys.readouterr().err


def test_probes_run_here():
    """The real probes of PETSc and of a package: their output is what the report reads."""
    status, output = environment._run(environment._python(environment._PETSC))
    about = json.loads(output.strip().splitlines()[-1])
    assert status == 0 and about["scalar"] == "float64" and set(about) >= {"mumps", "hypre", "ptscotch", "index"}
    status, output = environment._run(environment._python("import nothing_of_this_name"))
    assert status and environment._last(output) == "ModuleNotFoundError: No module named 'nothing_of_this_name'"


@pytest.mark.parametrize(
    ("folder", "files", "told"),
    [
        ("it", (), "No module named 'numba'; scripts/setup.sh makes an environment that has it"),
        (".venv", ("made-from",), "the environment {} is not finished: run bash scripts/setup.sh (No module"),
        (".venv-petsc", ("made-from",), "is not finished: run bash scripts/setup.sh --build-petsc (No module"),
        ("my own", ("made-from",), "is not finished: run PFEM_VENV='{}' bash scripts/setup.sh (No module"),
        (
            ".venv",
            ("made-from", "setup-done"),
            "lacks what it had: run bash scripts/setup.sh, then source .venv/bin/activate (No module named 'numba')",
        ),
    ],
)
def test_an_environment_that_is_not_finished_is_named(tmp_path, monkeypatch, capsys, folder, files, told):
    (tmp_path / folder).mkdir()
    for file in files:
        (tmp_path / folder / file).write_text("")
    monkeypatch.setattr(sys, "prefix", str(tmp_path / folder))

    def lacking():
        raise ModuleNotFoundError("No module named 'numba'", name="numba")

    assert on_first_rank(lacking, debug=False, uses_mpi=False) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and told.format(tmp_path / folder) in said and len(said.splitlines()) == 1


@pytest.mark.slow
def test_a_bare_environment_names_itself(tmp_path):
    """Python without any package, in an environment as setup.sh leaves it when it is killed early."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / ".venv")], check=True)
    (tmp_path / ".venv" / "made-from").write_text("")
    python, root = tmp_path / ".venv" / "bin" / "python", Path(__file__).parents[2]
    for words in (["rod_impact"], ["bench"], ["info", "it"], ["render", "it"]):
        command = [str(python), "-m", "pfem_petsc", *words]
        done = subprocess.run(command, cwd=root, env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)
        assert done.returncode == 2 and "Traceback" not in done.stderr
        assert f"the environment {tmp_path / '.venv'} is not finished: run bash scripts/setup.sh" in done.stderr


def test_a_numpy_that_is_too_new_has_its_remedy(tmp_path, monkeypatch):
    """In Python and on the command line: what petsc4py raises then, and nothing else."""
    (tmp_path / "binding_of_a_test.py").write_text('raise ValueError("numpy.dtype size changed, may indicate ...")')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(pfem_petsc._HOMES, "Bound", "binding_of_a_test")
    with pytest.raises(InputError, match=r'python -m pip install "numpy<2"') as caught:
        pfem_petsc.Bound  # noqa: B018 - imported at its first use
    assert exit_message(caught.value.__cause__) == (2, f"error: {caught.value}")
    assert exit_message(ValueError("numpy is here"))[1].startswith("internal error: ValueError")


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    file = tmp_path_factory.mktemp("completion") / "pfem.bash"
    with file.open("w") as out:
        subprocess.run([sys.executable, "-m", "pfem_petsc", "completion", "bash"], stdout=out, check=True, timeout=120)
    return file


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "expected", "not_expected"),
    [
        ("pfem-petsc ren", {"render"}, {"plot"}),
        ("pfem-petsc rod", {"rod_impact"}, {"ring_impact"}),
        ("pfem-petsc check ro", {"rod_impact"}, {"render"}),
        ("pfem-petsc plot results --f", {"--filter", "--format"}, {"--curves", "--frames"}),
        ("pfem-petsc rod_impact --q", {"--quiet"}, set()),
        ("pfem-petsc my_case.toml --q", {"--quiet"}, set()),
        ("pfem-petsc rod_impact --set time.s", {"time.step=", "time.safety="}, {"time.end="}),
        ("pfem-petsc rod_impact --set time.step=1e-3 material.default.y", {"material.default.young_modulus="}, set()),
        ("pfem-petsc bench --kind ", {"cubic", "octet", "bcc"}, {"rod_impact"}),
        ("pfem-petsc completion ", {"bash", "zsh"}, {"rod_impact"}),
        ("pfem-petsc mesh g", {"generate"}, {"rod_impact"}),
        ("pfem-petsc mesh generate ro", {"rod_impact", "rod"}, {"render"}),
        ("pfem-petsc mesh info a.vtu --to", {"--tolerance"}, {"--parts"}),
    ],
)
def test_bash_completes(script, line, expected, not_expected):
    words = line.replace("=", " = ").split(" ")  # as the shell splits them
    quoted, count = " ".join(f"'{word}'" for word in words), len(words)
    code = (
        f"compopt() {{ :; }}; source {script}; COMP_WORDS=({quoted}); COMP_CWORD={count - 1}; _shtab_pfem; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run([which("bash") or "/bin/bash", "-c", code], capture_output=True, text=True, check=True)
    found = set(done.stdout.split())
    assert expected <= found and not found & not_expected and not done.stderr


def test_keys_that_are_completed_exist(script):
    """A key of the script is not refused as unknown: for tables of the rod that have a value to write back."""
    keys = {word.rstrip('"') for word in script.read_text().replace('"', " ").split() if word.endswith("=")}
    assert len(keys) > 300 and set(built_in_cases()) <= set(script.read_text().replace('"', " ").split())
    case = Case.load("rod_impact").to_dict()
    for table in ("time", "mesh", "output"):
        for key in case[table]:
            assert f"{table}.{key}=" in keys or key == "probe", key


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_scripts_are_valid_and_have_the_words(shell, capsys, tmp_path):
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in HOMES) and "rod_impact" in text and "time.step=" in text
    if which(shell) is not None:
        (tmp_path / "script").write_text(text)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)
