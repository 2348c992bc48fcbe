"""Arguments of the command line, in this process: help, refusals, status, and imported modules."""

import subprocess
import sys

import pytest

from pfem_petsc import __version__
from pfem_petsc.case.toml import built_in_cases
from pfem_petsc.cli.cases import KINDS
from pfem_petsc.cli.main import HOMES as HOMES
from pfem_petsc.cli.main import main, seconds
from pfem_petsc.registry import choices


@pytest.mark.parametrize("verb", HOMES)
def test_help_has_an_example(verb, capsys):
    assert main([verb, "--help"]) == 0
    printed = capsys.readouterr().out
    assert "example" in printed
    assert f"python -m pfem_petsc {'' if verb == 'run' else verb}" in printed.partition("example")[2]


def test_help_and_version(capsys):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert set(HOMES) <= {line.split()[0] for line in printed.splitlines() if line.startswith("    ")}
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pfem_petsc {__version__}\n"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "CASE or a verb is missing"),
        (["--quiet"], "required: CASE"),
        (["--set", "time.end=1", "rod_impact"], "required: CASE (give it before --set and --restart)"),
        (["rod_impact", "--quite"], "unrecognized arguments: --quite"),
        (["rod_impact", "--qui"], "unrecognized arguments: --qui"),
        (["rod_impact", "second"], "unrecognized arguments: second"),
        (["rod_impact", "--wall-time", "soon"], "'soon' is not a duration"),
        (["rod_impact", "-o"], "-o/--output: expected one argument"),
        (["list", "extra"], "unrecognized arguments: extra"),
        (["list", "--", "-log_view"], "list takes no PETSc options: -log_view"),
        (["info"], "required: RESULT"),
        (["rod_impct"], "rod_impct: there is no such case file or built-in case; did you mean 'rod_impact'?"),
        (["rendr", "results/rod_impact"], "rendr: there is no such verb or case; did you mean 'render'?"),
        (["check", "rod_impact", "--set", "time.end=0"], "time.end = 0"),
        (["rod_impact", "--set", "time.end=0", "mesh.elements=x"], "time.end = 0"),
        (["rod_impact", "--set", "time.end=0", "--set", "mesh.elements=x"], 'mesh.elements = "x"'),
    ],
)
def test_refused_words(words, text, capsys):
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert text in printed.err
    assert printed.err.startswith("error: ")
    assert "Traceback" not in printed.err


def test_debug_shows_the_traceback(capsys):
    assert main(["rod_impact", "--set", "time.end=0", "--debug"]) == 2
    printed = capsys.readouterr().err
    assert "Traceback" in printed
    assert printed.splitlines()[-1].startswith("error: ")


def test_list_names_everything_on_offer(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {line.split()[0]: line.split(maxsplit=1)[1:] for line in lines if line.startswith("  ")}
    kinds = ("integrators", "mesh.generators", "contact.walls", "contact.constraints", "contact.treatments")
    kinds += ("mechanics.materials", "formats", "statics.methods")
    expected = {*built_in_cases(), *(name for kind in kinds for name in choices(f"pfem_petsc.{kind}"))}
    assert set(shown) - {"none"} == expected
    for kind in KINDS:  # also where nothing is built in
        assert f"{kind}:" in lines
    assert lines[lines.index("constraints:") + 1] == (
        "  none is built in; docs/extending.md has an example and says how to add one"
    )
    assert all(text for text in shown.values())
    assert "Elastic rod against a rigid wall" in "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "value"), [("90", 90.0), ("1.5", 1.5), ("1:30", 90.0), ("0:01:30", 90.0), ("2:00:00", 7200.0)]
)
def test_duration(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize("text", ["0", "-1", "1:-1", "x", "", "1:2:3:4", "inf", "nan"])
def test_no_duration(text):
    with pytest.raises(Exception, match="is not a duration"):
        seconds(text)


@pytest.mark.parametrize("statement", ["import pfem_petsc", "import pfem_petsc.cli.main as m; m.main(['--help'])"])
def test_light_import(statement):
    heavy = {"numpy", "numba", "petsc4py", "mpi4py", "pyvista", "vtk", "h5py", "matplotlib", "pydantic", "rich"}
    code = f"import sys; {statement}; print('loaded', *sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].split() == ["loaded"]


def test_without_its_environment_the_way_in_is_told():
    code = "import sys; sys.modules['mpi4py'] = None; import pfem_petsc.cli.main as m; sys.exit(m.main(['rod_impact']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "source .venv/bin/activate" in done.stderr
