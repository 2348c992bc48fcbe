"""From a case to results, and from results to summaries and pictures, by the command line."""

import re
import shlex
import subprocess
import sys

import pytest
from helpers.launch import environment

from pfem_petsc.cli.main import main


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "short"
    assert main(["rod_impact", "-o", str(folder), "--quiet", "--set", "time.end=0.5", "title=A short run"]) == 0
    return folder


def test_check_says_what_would_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["check", "rod_impact", "--set", "time.step=auto"]) == 0
    shown = capsys.readouterr().out
    rows = {line[2:].partition("  ")[0]: line for line in shown.splitlines() if line.startswith("  ")}
    assert rows["nodes"].split()[-1] == "21"
    assert rows["critical step"].split()[-2:] == ["50.00", "ms"]
    assert rows["time step"].endswith("44.6429 ms, 112 steps to 5.000 s")  # 0.9 of the limit, made to divide the end
    assert shown.splitlines()[-1] == "This case can run."
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("time.step=1.0", "time.step"),
        ("wall.0.point=[0.5, 0.0, 0.0]", "beyond the wall"),
        ("mesh.elements=4000000000000000000", "mesh.elements"),
        ("section.default.bars=none", "section"),
        ("node_set.tip={group = 'tp'}", "tip"),
    ],
)
def test_check_refuses_what_cannot_run(override, text, capsys):
    assert main(["check", "rod_impact", "--set", override]) == 2
    printed = capsys.readouterr()
    assert text in printed.err
    assert "Traceback" not in printed.err
    assert "can run" not in printed.out


def test_results_go_to_a_folder_named_after_the_case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["rod_impact", "--quiet", "--set", "time.end=0.05"]
    assert main(words) == 0
    assert (tmp_path / "results" / "rod_impact" / "result.vtkhdf").is_file()
    assert main(words) == 0
    assert len(list((tmp_path / "results").iterdir())) == 2


def test_a_run_says_where_earlier_results_went_and_how_energy_drifts(tmp_path, capsys):
    """From rest, too, where the energy at the start is none to compare with."""
    folder = tmp_path / "swing"
    words = ["pendulum", "-o", str(folder), "--set", "time.end=0.2"]
    assert main(words) == 0
    assert "earlier results" not in capsys.readouterr().out
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert f"{folder}: earlier results were moved to {folder}.1" in shown
    assert "\n  ranks          1\n" in shown
    assert abs(float(re.search(r"energy drift (\S+)", shown)[1])) < 1e-9


def test_info(short_run, capsys):
    assert main(["info", str(short_run)]) == 0
    by_folder = capsys.readouterr().out
    assert main(["info", str(short_run / "result.vtkhdf")]) == 0
    assert capsys.readouterr().out == by_folder
    lines = by_folder.splitlines()
    assert lines[0] == "A short run"
    rows = {line.split()[0]: line.split(maxsplit=1)[1] for line in lines if line.startswith("  ")}
    assert rows["mesh"] == "21 nodes, 20 bars"
    assert rows["ranks"] == "1"
    assert rows["snapshots"] == "6: 0 s to 500.0 ms"
    assert rows["history"] == "51 rows: 0 s to 500.0 ms"
    assert "wall/wall/force" in by_folder
    balance = next(line for line in lines if "balance error" in line)
    assert float(balance.partition("(")[2].split()[0]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["info", "plot", "render"])
def test_result_that_is_none(verb, tmp_path, capsys):
    assert main([verb, str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    (tmp_path / "result.vtkhdf").write_text("this is no HDF5 file")
    assert main([verb, str(tmp_path)]) == 2
    assert str(tmp_path / "result.vtkhdf") in capsys.readouterr().err


def test_a_reader_that_ends_early_ends_the_verb(short_run):
    """Also of verbs that import PETSc, whose handler of broken pipes ends a process with a message of its own."""
    command = f"{shlex.quote(sys.executable)} -m pfem_petsc members {shlex.quote(str(short_run))}"
    done = subprocess.run(
        ["bash", "-c", f"{command} | true; echo ${{PIPESTATUS[0]}}"],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.stdout, done.stderr) == ("0\n", "")
