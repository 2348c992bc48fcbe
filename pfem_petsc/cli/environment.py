"""What this machine has of what the program needs, and the commands that bring what is missing."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from typing import Any, NamedTuple

Run = Callable[[list[str]], tuple[int, str]]
"""Returns status and output of a command."""

LIMIT = 120.0  # seconds of a probe; the first import of some packages compiles them

PACKAGES = {  # distribution: module, and what it is for
    "numpy": ("numpy", "arrays"),
    "numba": ("numba", "compiled loops"),
    "scipy": ("scipy", "filters, modes"),
    "pydantic": ("pydantic", "case files"),
    "rich": ("rich", "progress"),
    "shtab": ("shtab", "completion in shells"),
    "matplotlib": ("matplotlib", "curves"),
    "Pillow": ("PIL", "pictures"),
    "vtk": ("vtkmodules", "pictures"),
    "pyvista": ("pyvista", "pictures"),
    "imageio-ffmpeg": ("imageio_ffmpeg", "films"),
}
OPTIONAL = {
    "pyNastran": ("pyNastran", "Nastran files"),
    "meshio": ("meshio", "foreign mesh formats"),
    "plotly": ("plotly", "render --html"),
    "slepc4py": ("slepc4py", "modes of large models"),
    "pandas": ("pandas", "tables as data frames"),
}

_PETSC = """
import json
import petsc4py; petsc4py.init()
from petsc4py import PETSc
import numpy
packages = ("mumps", "hypre", "ptscotch", "superlu_dist", "parmetis")
has = getattr(PETSc.Sys, "hasExternalPackage", lambda name: None)
print(json.dumps({"version": ".".join(map(str, PETSc.Sys.getVersion())), "scalar": str(numpy.dtype(PETSc.ScalarType)),
    "index": str(numpy.dtype(PETSc.IntType)), **{name: has(name) for name in packages}}))
"""
_MPI = "from mpi4py import MPI; print(MPI.Get_library_version().split(chr(0))[0].splitlines()[0].split(',')[0].strip())"
_TOGETHER = """
from mpi4py import MPI
import petsc4py; petsc4py.init()
from petsc4py import PETSc
import h5py, json
found = [MPI.COMM_WORLD.size, PETSc.COMM_WORLD.size]
found += [bool(h5py.get_config().mpi), h5py.version.hdf5_version, h5py.__file__]
if MPI.COMM_WORLD.rank == 0: print("found " + json.dumps(found), flush=True)
"""


class Finding(NamedTuple):
    """One line of the report.

    Attributes
    ----------
    name : what was looked for
    state : ``ok``, ``missing``, or ``optional`` (missing, and not needed for runs)
    text : version and features, or what fails without it
    remedy : the command that brings it
    """

    name: str
    state: str
    text: str
    remedy: str = ""


def inspect_environment(run: Run | None = None) -> list[Finding]:
    """Return what is there and what is missing. Each probe is a separate process, because broken libraries may crash.

    Parameters
    ----------
    run : returns status and output of a command; default: runs it
    """
    run, bring = run or _run, remedies()
    version = ".".join(map(str, sys.version_info[:3]))
    old = f"{version} is too old: 3.11 or newer is needed" if sys.version_info < (3, 11) else ""
    return [
        _finding("python", old, version, bring["python"]),
        *_packages(PACKAGES, "missing", bring, run),
        *_mpi_and_petsc(bring, run),
        _launcher(bring, run),
        _drawing(bring, run),
        *_packages(OPTIONAL, "optional", bring, run),
    ]


def report(found: Iterable[Finding]) -> list[str]:
    """Return the lines of the report: what is there, then what is missing with the command that brings it."""
    found = list(found)
    width = max(len(each.name) for each in found)
    lines = [f"  {each.state:8}  {each.name:{width}}  {each.text}" for each in found]
    commands = dict.fromkeys(each.remedy for each in found if each.state != "ok" and each.remedy)
    if commands:
        lines += ["", "to install what is missing:", *(f"  {command}" for command in commands)]
    return lines


def remedies() -> dict[str, str]:
    """Return the commands that bring things here: of conda in its environments, of Debian where apt-get is."""
    pip = f"{os.path.relpath(sys.executable) if sys.prefix != sys.base_prefix else 'python3'} -m pip install "
    conda = "conda install -c conda-forge "
    apt = "apt-get install --no-install-recommends "
    table = {  # in conda, on Debian, elsewhere
        "pip": (conda, pip, pip),
        "python": (
            conda + '"python>=3.11"',
            "a distribution with Python 3.11 or newer, or conda (docs/installing.md)",
            "Python 3.11 or newer, for example by conda (docs/installing.md)",
        ),
        "mpi4py": (conda + "mpi4py openmpi", apt + "python3-mpi4py openmpi-bin", pip + "mpi4py"),
        "petsc4py": (
            conda + "petsc4py petsc=*=real*",
            apt + "python3-petsc4py-real, or bash scripts/setup.sh",
            "module load petsc, set PETSC_DIR, or bash scripts/setup.sh --build-petsc",
        ),
        "h5py": (
            conda + '"h5py=*=mpi*"',
            apt + "python3-h5py-mpi",
            "HDF5_MPI=ON CC=mpicc " + pip + "--no-binary=h5py h5py",
        ),
        "slepc4py": (conda + "slepc4py", apt + "python3-slepc4py-real", pip + "slepc4py"),
        "drawing": (
            conda + "mesalib",
            apt + "libosmesa6, or libegl1 libgl1-mesa-dri",
            "OSMesa or EGL of Mesa, for example by module load mesa",
        ),
    }
    system = 0 if os.environ.get("CONDA_PREFIX") else 1 if shutil.which("apt-get") else 2
    return {what: commands[system] for what, commands in table.items()}


def _run(command: list[str]) -> tuple[int, str]:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return 1, str(error)
    return done.returncode, done.stdout if done.returncode == 0 else done.stdout + done.stderr


def _python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def _finding(name: str, problem: str, text: str, remedy: str, lacking: str = "missing") -> Finding:
    return Finding(name, lacking, problem, remedy) if problem else Finding(name, "ok", text)


def _too_old(version: str, minimum: str) -> str:
    parts = [[int(part) for part in re.findall(r"\d+", text)[:3]] for text in (version, minimum)]
    return f"{version} is too old: {minimum} or newer is needed" if minimum and parts[0] < parts[1] else ""


def _packages(packages: dict[str, tuple[str, str]], lacking: str, bring: dict[str, str], run: Run) -> Iterator[Finding]:
    required: list[str] = []
    with contextlib.suppress(metadata.PackageNotFoundError):
        required = metadata.requires("pfem_petsc") or []
    pairs = (re.match(r"([\w.-]+)>=([\d.]+)$", text.split(";")[0].strip()) for text in required)
    minimum = {pair[1].lower(): pair[2] for pair in pairs if pair}
    for name, (module, use) in packages.items():
        code = f"import {module}; from importlib.metadata import version; print(version({name!r}))"
        status, output = run(_python(code))
        version, least = output.strip(), minimum.get(name.lower(), "") if lacking == "missing" else ""
        problem = f"cannot be imported: {_last(output)}" if status else _too_old(version, least)
        remedy = bring.get(name, bring["pip"] + (f'"{name}>={least}"' if least else name))
        yield _finding(name, problem and f"{problem} ({use})", version, remedy, lacking)


def _mpi_and_petsc(bring: dict[str, str], run: Run) -> Iterator[Finding]:
    status, output = run(_python(_MPI))
    problem = f"cannot be imported: {_last(output)}" if status else ""
    yield _finding("mpi4py", problem, output.strip(), bring["mpi4py"])
    status, output = run(_python(_PETSC))
    if status:
        old = "numpy.dtype size changed" in output or "compiled using NumPy 1" in output
        remedy = bring["pip"] + '"numpy<2"' if old else bring["petsc4py"]
        yield Finding("petsc4py", "missing", f"cannot be imported: {_last(output)}", remedy)
        return
    about: dict[str, Any] = json.loads(output.strip().splitlines()[-1])
    text = f"PETSc {about['version']}, {about['scalar']}, {about['index']} indices"
    problem = f"{text}: 3.18 or newer is needed" if _too_old(about["version"], "3.18") else ""
    problem = problem if about["scalar"] == "float64" else f"{text}: a real, double build is needed"
    yield _finding("petsc4py", problem, text, bring["petsc4py"])
    uses = {"mumps": "direct solver on ranks", "hypre": "-pc_type hypre", "ptscotch": "partitions of mesh files"}
    for name, use in uses.items():
        lack = "not reported by this petsc4py" if about[name] is None else "not in this PETSc"
        remedy = "" if about[name] is None else bring["petsc4py"]
        yield _finding(f"petsc: {name}", "" if about[name] else f"{lack} ({use})", use, remedy, "optional")


def _launcher(bring: dict[str, str], run: Run) -> Finding:
    """Two ranks: one MPI for all, and a parallel h5py."""
    launcher = shutil.which("mpirun") or shutil.which("mpiexec")
    if launcher is None:
        return Finding("2 ranks", "missing", "there is no mpirun in PATH: runs on one rank work", bring["mpi4py"])
    status, output = run([launcher, "-n", "2", *_python(_TOGETHER)])
    line = re.search(r"^found (.*)$", output, flags=re.MULTILINE)
    text, remedy = "", bring["h5py"]
    if status or line is None:
        text, remedy = f"mpirun -n 2 fails: {_last(output)}", bring["mpi4py"]
        if "run as root" in output:
            text = "Open MPI refuses to run as root: runs on one rank work"
            remedy = "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"
        return Finding("2 ranks", "missing", text, remedy)
    mpi, petsc, parallel, hdf5, file = json.loads(line[1])
    if not mpi == petsc == 2:
        text = f"mpi4py sees {mpi} rank(s) and PETSc {petsc}: these and mpirun belong to different MPI installations"
        remedy = bring["petsc4py"]
    elif not parallel:
        text = f"h5py (HDF5 {hdf5}) in {file} is not the parallel build"
        if remedy.startswith("apt-get") and file.startswith(sys.prefix + os.sep) and sys.prefix != sys.base_prefix:
            # a wheel in the environment hides the one of the distribution
            remedy = bring["pip"].replace(" install ", " uninstall --yes ") + f"h5py && {remedy}"
    return _finding("2 ranks", text, f"mpirun, mpi4py and PETSc agree; h5py is parallel (HDF5 {hdf5})", remedy)


def _drawing(bring: dict[str, str], run: Run) -> Finding:
    code = "from pfem_petsc.post.scene import require_rendering as r; r(); import os; "
    status, output = run(_python(code + "print(os.environ.get('VTK_DEFAULT_OPENGL_WINDOW', 'default'))"))
    problem = "render, report and grid.plot() cannot draw (runs and plot need none)" if status else ""
    window = output.strip().rpartition("\n")[2].removeprefix("vtk")
    return _finding("OpenGL", problem, window, bring["drawing"], "optional")


def _last(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip() and not line.startswith("-----")]
    errors = [line for line in lines if re.match(r"\w*(Error|Exception)\b", line)]
    return (errors or lines or ["no message"])[-1][:160]
