"""The report of a run: lines, quiet mode, log file, and the bar."""

from __future__ import annotations

import io
import itertools
import shutil

import pytest
from mpi4py import MPI

from pfem_petsc.errors import InputError
from pfem_petsc.output.progress import Progress, Span
from pfem_petsc.output.units import duration, engineering

COMM = MPI.COMM_SELF


class Clock:
    """A clock that goes when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def run(steps: int, wall_per_step: float, **options) -> str:
    clock, stream = Clock(), io.StringIO()
    span = Span(options.pop("n_steps", steps), 1e-3 * steps)
    progress = Progress(COMM, "Rod", span, stream=stream, clock=clock, **options)
    progress.summary({"nodes": "21", "critical step": "2.0 µs"})
    for step in range(1, steps + 1):
        clock.now += wall_per_step
        progress.update(step, 1e-3 * step, 1e-3, newton=2, linear=30, contacts=3, energy_drift=-1.5e-6)
    progress.close()
    return stream.getvalue()


def test_summary_and_final_line():
    lines = run(10, 0.01).splitlines()
    assert lines[0] == "Rod"
    assert lines[1] == "  nodes          21"
    assert lines[2] == "  critical step  2.0 µs"
    assert lines[-1] == "done: 10 steps in 0.10 s (100 steps/s), t = 10.00 ms, 20 Newton and 300 linear iterations"


def test_line_says_where_the_run_is():
    lines = [line for line in run(100, 0.125).splitlines() if line.startswith("step")]
    first = lines[0]
    assert first.split()[1] == "16/100" and " 16 %" in first
    assert "t = 16.00 ms" in first and "dt = 1.00 ms" in first
    assert "Newton 2.0/step" in first and "linear 30.0/step" in first
    assert "contacts 3" in first and "energy drift -1.5e-06" in first
    assert "8 steps/s" in first and "ETA 10.5 s" in first
    assert "100 %" in lines[-1] and "ETA 0.00 s" in lines[-1]
    by_time = next(line for line in run(100, 0.125, n_steps=None).splitlines() if line.startswith("step"))
    assert " 16 %" in by_time and "ETA 10.5 s" in by_time and "/100" not in by_time


def test_a_path_that_ends_before_its_last_point_is_done():
    clock, stream = Clock(), io.StringIO()
    progress = Progress(COMM, "Dome", Span(1000, 1000.0), stream=stream, clock=clock)
    for step in range(1, 21):
        clock.now += 0.01
        progress.update(step, float(step), 1.0)
    progress.close()
    last = [line for line in stream.getvalue().splitlines() if line.startswith("step")][-1]
    assert "20/1000 100 %" in last and last.endswith("ETA 0.00 s")


def test_intervals_stretch_from_two_to_ten_seconds(tmp_path):
    lines = [line for line in run(1000, 0.1).splitlines() if line.startswith("step")]
    at = [0.1 * int(line.split("/")[0].split()[-1]) for line in lines]
    gaps = [b - a for a, b in itertools.pairwise(at)]
    assert at[0] == pytest.approx(2.0, abs=0.11)
    assert gaps[0] == pytest.approx(2.5, abs=0.11)
    assert max(gaps) == pytest.approx(10.0, abs=0.11)
    assert len(lines) < 20


def test_restart_first_step_and_compiling_are_no_measure_of_what_remains():
    """Twenty seconds for the first step, and eight in a later one: the others take an eighth of a second."""
    clock, stream = Clock(), io.StringIO()
    progress = Progress(COMM, "Rod", Span(200, 2.0, first_step=100, start=1.0), stream=stream, clock=clock)
    for step in range(101, 201):
        clock.now += 0.125 + {101: 20.0, 115: 8.0}.get(step, 0.0)
        if step == 115:
            progress.compiled(8.0)
        progress.update(step, 0.01 * step, 0.01)
    progress.close()
    lines = [line for line in stream.getvalue().splitlines() if line.startswith("step")]
    assert "101/200" in lines[0] and "ETA" in lines[0] and "steps/s" not in lines[0]
    for line in lines[1:]:
        left = 200 - int(line.split("/")[0].split()[-1])
        assert "  8 steps/s" in line
        assert f"ETA {duration(left / 8.0)}" in line
    assert "done: 100 steps in 40.5 s, including 8.00 s for compiling (3.1 steps/s)" in stream.getvalue()


def test_quiet_writes_the_log_only(tmp_path, capsys):
    log = tmp_path / "results" / "log.txt"
    assert run(100, 0.125, quiet=True, log_path=log) == ""
    assert capsys.readouterr().out == ""
    text = log.read_text()
    assert "nodes          21" in text and "step  16/100" in text and "done: 100 steps" in text


def test_log_has_date_and_level_and_is_continued(tmp_path, capsys):
    log = tmp_path / "log.txt"
    for _ in range(2):
        progress = Progress(COMM, "Rod", Span(1, 1.0), log_path=log, stream=io.StringIO())
        progress.message("checkpoint written")
        progress.warning("node 3 is fast")
        progress.close()
    lines = log.read_text().splitlines()
    assert sum("done" in line for line in lines) == 2
    date, time, level, *text = lines[1].split()
    assert (len(date), len(time), level, " ".join(text)) == (10, 8, "WARNING", "node 3 is fast")
    assert lines[0].split()[2:] == ["INFO", "checkpoint", "written"]
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("warning: node 3 is fast") == 2


@pytest.mark.parallel
def test_unwritable_log_is_refused_on_all_ranks(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"log\.txt.*choose another output folder"):
        Progress(MPI.COMM_WORLD, "Rod", Span(10, 1.0), log_path=tmp_path / "file" / "log.txt", stream=io.StringIO())


def test_lost_log_is_said_once_and_the_run_goes_on(tmp_path, capsys):
    folder = tmp_path / "results"
    stream = io.StringIO()
    progress = Progress(COMM, "Rod", Span(10, 1.0), log_path=folder / "log.txt", stream=stream)
    shutil.rmtree(folder)
    progress.message("one")
    progress.message("two")
    progress.close()
    error = capsys.readouterr().err
    assert error.count("the log cannot be written any more") == 1
    assert "one" in stream.getvalue() and "two" in stream.getvalue() and "done" in stream.getvalue()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_bar_on_a_terminal_and_lines_under_a_launcher(monkeypatch):
    for name in ("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    assert _drawn_by_bar()
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "2")
    assert not _drawn_by_bar()


def _drawn_by_bar() -> bool:
    stream, clock = Terminal(), Clock()
    progress = Progress(COMM, "Rod", Span(10, 1.0), stream=stream, clock=clock)
    for step in range(1, 11):
        clock.now += 0.2
        progress.update(step, 0.1 * step, 0.1, contacts=4)
    progress.message("[brackets] stay")
    progress.close()
    text = stream.getvalue()
    assert "[brackets] stay" in text and "done: 10 steps" in text
    return "5/10  t = 500.0 ms  contacts 4" in text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2.4e-6, "s", "2.400 µs"),
        (2.1e11, "Pa", "210.0 GPa"),
        (-3.21e4, "N", "-32.10 kN"),
        (2.28e8, "B", "228.0 MB"),
        (0.0, "J", "0 J"),
        # prefixes that nobody uses are left out, never one beside a power of ten
        (0.5, "Pa", "0.5000 Pa"),
        (2.5e-5, "Pa", "2.500e-05 Pa"),
        (-2.3e-16, "J", "-2.300e-16 J"),
        (3.1e-5, "N", "31.00 µN"),
        (12.5, "K", "12.50 K"),
        (float("nan"), "s", "nan s"),
    ],
)
def test_engineering_prefixes(value, unit, text):
    assert engineering(value, unit) == text


def test_durations():
    assert [duration(s) for s in (0.421, 12.34, 187, 7541, float("inf"))] == [
        "0.42 s",
        "12.3 s",
        "3:07",
        "2:05:41",
        "?",
    ]


def test_a_warning_is_told_once_and_briefly_if_quiet(tmp_path, capsys):
    """The log has all of it; the folder of the results is the last line."""
    long = "bars are thin, " * 30 + "make them thicker"
    for quiet in (False, True):
        log = tmp_path / str(quiet) / "log.txt"
        stream = io.StringIO()
        progress = Progress(COMM, "it", Span(2, 1.0), quiet, log, stream)
        for text in (long, "walls are far", long, "walls are far"):
            progress.warning(text)
        progress.close(results=log.parent)
        told = capsys.readouterr().err.splitlines()
        assert len(told) == 2 and told[1] == "warning: walls are far"
        if quiet:
            brief, _, rest = told[0].partition(" ... ")
            assert 220 < len(brief) <= 236 and brief.startswith("warning: bars are thin, bars are")
            assert rest == f"({log})"
        else:
            assert told[0] == f"warning: {long}"
        assert log.read_text().count(long) == 1 and log.read_text().endswith(f"results in {log.parent}\n")
        assert quiet == (stream.getvalue() == "") and (quiet or stream.getvalue().endswith(f"in {log.parent}\n"))
