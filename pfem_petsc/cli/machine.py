"""This machine: what it has of what the program needs, with the commands that bring what is missing; and the verb that
measures it."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import bench
from ..errors import InputError, written
from .main import PROGRAM, Verb, argument, start_petsc

if TYPE_CHECKING:
    from mpi4py import MPI

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


BENCH = f"""\
examples:
  {PROGRAM} bench
  mpirun -n 2 {PROGRAM} bench --sizes 100000 1000000 --jobs explicit matrix_free -o bench.json

Steps are wall-clock times (median and best), cpu the processor time of all ranks; see docs/performance.md. Nothing else
should run during the measurement.

exit status: 0 done, 2 invalid input, 3 a run failed"""


_MOST = 10**12
"""Bars of the largest lattice that can be asked for; no machine has the memory."""


def _size(text: str) -> int:
    with contextlib.suppress(ValueError, OverflowError):
        if 0 < float(text) == int(float(text)) <= _MOST:
            return int(float(text))
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number up to {_MOST:,}")


OF_BENCH = (
    argument(
        "--sizes",
        metavar="BARS",
        type=_size,
        nargs="+",
        default=[10_000, 100_000, 1_000_000],
        help="approximate numbers of bars",
    ),
    argument("--kind", choices=list(bench.KINDS), default="cubic", help="cells of the lattice"),
    argument(
        "--jobs", choices=list(bench.JOBS), nargs="+", default=list(bench.JOBS), help="what to time; default: all"
    ),
    argument("--explicit", metavar="NAME", default="central_differences", help="explicit integrator"),
    argument("--implicit", metavar="NAME", default="newmark", help="implicit integrator"),
    argument("--mass", choices=("lumped", "consistent"), default="lumped", help="mass matrix"),
    argument(
        "--plastic",
        action=argparse.BooleanOptionalAction,
        help="bars that yield; default: in explicit_contact only",
    ),
    argument("--history-every", metavar="N", type=_size, default=1, help="steps between rows of the history"),
    argument("--seconds", metavar="T", type=float, default=2.0, help="approximate time for each job"),
    argument(
        "--compile",
        action="store_true",
        help="only compile the loops of the jobs and of all material laws for later runs; measure nothing",
    ),
    argument("-o", "--output", metavar="FILE", type=Path, help="write all figures as JSON"),
)


def measure(arguments: argparse.Namespace, comm: MPI.Comm) -> int:
    """Measure and print. Collective."""
    start_petsc(arguments.petsc_options, comm.rank)
    from ..parallel.agreement import agreed

    if not 0.0 < arguments.seconds < float("inf"):
        raise InputError(f"--seconds {arguments.seconds}: give a positive time")
    if arguments.output is not None:  # before the measurements, which take minutes
        with agreed(comm), written(arguments.output, "the figures"):
            arguments.output.open("a").close()

    def say(text: str) -> None:
        if comm.rank == 0:
            print(text, flush=True)

    kind, seconds, explicit = arguments.kind, arguments.seconds, arguments.explicit
    chosen = bench.jobs(
        arguments.jobs, explicit, arguments.implicit, arguments.mass, arguments.plastic, arguments.history_every
    )
    if arguments.compile:
        begin = time.perf_counter()
        bench.compile_loops(chosen, kind, explicit, comm)
        say(f"loops for this machine are compiled: {time.perf_counter() - begin:.1f} s")
        return 0
    for job in chosen:  # compile or load kernels and start libraries before the measurements
        bench.time_job(job, kind, 2, comm, 0.0)
    title = f"{bench.processor()}, {comm.size} rank{'s' if comm.size > 1 else ''}, {kind} lattices"
    say(title)
    bandwidth = bench.measure_bandwidth(comm)
    say(bench.machine_lines(bandwidth, comm.size))
    say(bench.HEADER)
    records = []
    for size in sorted(arguments.sizes):
        for job in chosen:
            records.append(bench.time_job(job, kind, bench.cells_for(kind, size), comm, seconds))
            say(bench.line(records[-1]))
    say("")
    for name, slope in bench.memory_slopes(records).items():
        say(f"memory of {name}: {slope:.0f} B per additional bar")
    tiny = [bench.time_job(job, "cubic", 2, comm, seconds, 3000) for job in bench.tiny_jobs(explicit)]
    for record in tiny:
        say(f"outside the loops over bars and nodes: {1e6 * record.median:.0f} us a step ({record.job})")
    if arguments.output and comm.rank == 0:
        arguments.output.write_text(bench.document(comm, bandwidth, records, tiny), encoding="utf-8")
    return 0


VERBS = (
    Verb(
        "bench",
        "Measure this machine: memory bandwidth, then explicit, implicit and contact steps of lattices.",
        BENCH,
        "all",
        OF_BENCH,
        measure,
    ),
)
