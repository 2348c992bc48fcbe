"""Sweeps: a row for each combination, also for runs that fail or crash."""

from __future__ import annotations

import csv
import gc
import os
import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, InputError, Simulation, Truss, open_result, sweep
from pfem_petsc.cli import cases as verb
from pfem_petsc.cli.main import main
from pfem_petsc.mechanics.compiled import count_compiled
from pfem_petsc.output.result import peak_force
from pfem_petsc.output.table import Table
from pfem_petsc.post.plot import labels_of
from pfem_petsc.solvers import matrix_free as outlive
from pfem_petsc.studies import Task, environment, performed


@pytest.fixture(scope="module")
def rod():
    return Case.load("rod_impact", ["time.end=0.3", "output.fields_every=0"])


@pytest.mark.slow
def test_rows_of_all_combinations(rod, tmp_path):
    speeds = [0.3, 1.0]
    vary = {"time.step": [0.01, -1.0, 0.02], "initial.velocity": [np.array([v, 0.0, 0.0]) for v in speeds]}
    results = {"kinetic": "kinetic_energy", "peak": lambda result: result.history["wall/wall/force"][:, 0].min()}
    table = sweep(rod, vary, processes=2, results=results, output=tmp_path / "out", quiet=True)
    assert list(table)[:3] == ["run", "time.step", "initial.velocity"]
    assert table["run"].tolist() == list(range(6))
    assert table["time.step"].tolist() == [0.01, 0.01, -1.0, -1.0, 0.02, 0.02]
    assert table["initial.velocity"][:2].tolist() == [[0.3, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert table["status"].tolist() == [0, 3, 2, 2, 0, 3]
    assert "bar 19 between nodes 19 and 20" in table["message"][1] and not table["message"][0]
    assert "time.step = -1.0: expected a finite number" in table["message"][2]
    assert np.isnan(table["kinetic"][[1, 2, 3, 5]]).all()
    # the same numbers as of single runs, and of a body in flight
    history = open_result(tmp_path / "out" / "0004").history
    assert table["kinetic"][4] == history["kinetic_energy"][-1]
    assert table["peak"][4] == history["wall/wall/force"][:, 0].min() < -0.1
    assert table["steps"].tolist()[:3] == [30, 12, 0] and (table["wall_time"][[0, 1, 4]] > 0.0).all()
    rows = list(csv.DictReader((tmp_path / "out" / "sweep.csv").open()))
    assert [float(row["kinetic"]) for row in rows if row["status"] == "0"] == table["kinetic"][[0, 4]].tolist()
    assert rod.time.step == 0.01


@pytest.mark.slow
def test_default_results_and_removed_folders(rod, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    table = sweep(rod, [{"time.end": 0.05}, {"time.end": 0.3}], output=tmp_path / "out", keep=False, quiet=True)
    assert (table["status"] == 0).all()
    assert table["final_time"] == pytest.approx([0.05, 0.3]) and table["final_kinetic_energy"][0] == pytest.approx(
        0.125
    )
    assert table["peak_wall/wall/force"][0] == 0.0 < table["peak_wall/wall/force"][1]
    assert "final_thermal_work" not in table  # there is none
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sweep.csv"]
    assert (tmp_path / "out.1" / "old").exists()


@pytest.mark.slow
def test_a_truss_and_what_a_function_raises(tmp_path):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0.3, 1, 0], [0.3, 0.3, 0.8]])
    bars = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]
    case = Case(
        name="pyramid",
        mesh=Truss(points, bars),
        material={"m": {"young_modulus": 1e6, "density": 1.0}},
        section={"s": {"area": 1e-4, "material": "m"}},
        initial={"velocity": [0, 0, 1.0]},
        time={"integrator": "central_differences", "step": "auto", "end": 1e-3},
    )
    scaled = [Truss(points * factor, bars) for factor in (1.0, 2.0)]

    def energy(result):
        return {"energy": result.history["kinetic_energy"][0] / (result.positions(0).max() < 1.5)}

    with np.errstate(divide="raise"):
        table = sweep(case, {"mesh": scaled}, results=energy, output=tmp_path / "out", keep=False, quiet=True)
    assert table["energy"][0] == pytest.approx(0.5e-4 * scaled[0].lengths.sum()) and np.isnan(table["energy"][1])
    assert table["status"].tolist() == [0, 1]
    assert table["message"].tolist() == ["", "results: FloatingPointError: divide by zero encountered in scalar divide"]
    # what a function could not use is not removed
    assert [(tmp_path / "out" / f"000{k}" / "result.vtkhdf").exists() for k in (0, 1)] == [False, True]


def test_refused(rod, tmp_path):
    for vary, told in (
        ({"time.stepp": [1.0]}, "time.stepp: unknown key"),
        ({"time.step": 1.0}, "expected a list of values"),
        ({"time.step": []}, "nothing to run"),
        ({"status": [1]}, "a column of the table"),
    ):
        with pytest.raises(InputError, match=told):
            sweep(rod, vary, output=tmp_path / "out", quiet=True)
    with pytest.raises(InputError, match="processes = 0"):
        sweep(rod, {"time.end": [0.1]}, processes=0)
    assert not (tmp_path / "out").exists()


class Killer:
    def __reduce__(self):
        return exec, ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)",)


@pytest.mark.slow
def test_a_crash_is_a_report_and_others_go_on(rod, tmp_path):
    tasks = [Task(Killer(), tmp_path / "0", None), Task(rod, tmp_path / "1", None)]
    reports = dict(performed(tasks, 1))
    assert [reports[k].status for k in range(2)] == [-9, 0]
    assert reports[0].message == "the process of the run ended by SIGKILL"


@pytest.mark.slow
def test_leaving_ends_the_runs(rod, tmp_path):
    long = rod.copy({"time.end": 1e4})
    runs = performed([Task(rod, tmp_path / "0", None), Task(long, tmp_path / "1", None)], 1)
    assert next(runs)[0] == 0
    runs.close()  # ends the long run, of 10^6 steps


@pytest.mark.slow
def test_a_killed_sweep_leaves_no_run_behind(tmp_path):
    command = ["sweep", "rod_impact", "--vary", "time.end=1e4", "-o", str(tmp_path / "out"), "--quiet"]
    variables = environment()
    sweeping = subprocess.Popen([sys.executable, "-m", "pfem_petsc", *command], env=variables)
    lock = tmp_path / "out" / "0000.lock"
    while not lock.exists():
        assert sweeping.poll() is None
        time.sleep(0.05)
    sweeping.kill()
    sweeping.wait()
    while lock.exists():
        time.sleep(0.05)
    # the lock is given back by a run that has stopped with a checkpoint
    assert (tmp_path / "out" / "0000" / "checkpoint.h5").exists()


def test_environment_is_not_that_of_a_rank(monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "3")
    monkeypatch.setenv("PMIX_RANK", "3")
    monkeypatch.setenv("OMPI_MCA_btl", "self")
    found = environment()
    assert "OMPI_COMM_WORLD_RANK" not in found and "PMIX_RANK" not in found and found["OMPI_MCA_btl"] == "self"


@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    words = [
        "sweep",
        "rod_impact",
        "--set",
        "time.end=0.05",
        "--vary",
        "time.step=0.01,0.5",
        "-o",
        str(tmp_path / "out"),
    ]
    assert main([*words, "--results", "kinetic_energy", "--quiet"]) == 3
    printed = capsys.readouterr().out
    assert "0.5       2  " in printed and "..." in printed and printed.strip().endswith("sweep.csv")
    assert "time.step = 0.5" in (tmp_path / "out" / "sweep.csv").read_text()
    assert main(["sweep", "rod_impact", "--vary", "time.step"]) == 2
    assert "--vary time.step: expected KEY=VALUES" in capsys.readouterr().err
    assert main(["sweep", "rod_impact", "--vary", "time.step=0.01", "time.step=0.02"]) == 2
    assert "--vary time.step=...: given twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("auto,1e-7", ["auto", 1e-7]),
        ("a.msh,b.msh", ["a.msh", "b.msh"]),
        ("[1,0,0],[2,0,0]", [[1, 0, 0], [2, 0, 0]]),
        ("octet, cubic", ["octet", "cubic"]),
        ('auto,[[1,2],[3,4]],{a=1,b=[2,3]},"x,y",true', ["auto", [[1, 2], [3, 4]], {"a": 1, "b": [2, 3]}, "x,y", True]),
    ],
)
def test_values_of_a_command_line(text, values):
    assert verb._values(f"key={text}") == ("key", values)


@pytest.mark.slow
def test_a_run_with_warnings_says_so(rod, tmp_path):
    """Where its row is otherwise that of a run without: runs are compared by the table."""
    changes = {"time.integrator": ["newmark", "generalized_alpha"]}
    table = sweep(rod, changes, output=tmp_path / "out", quiet=True)
    assert table["status"].tolist() == [0, 0]
    assert table["message"][0] == ""
    assert re.match(r"\d+ warnings?: contact: generalized_alpha .* gains energy in impacts", table["message"][1])


@pytest.mark.slow
def test_comparisons_name_what_varies(rod, tmp_path):
    """In the place of the folders of the runs, where that is known and distinct."""
    changes = [{"time.step": step, "time.end": end} for step, end in ((0.01, 0.1), (0.02, 0.1), (0.01, 0.2))]
    sweep(rod, [*changes, {"time.end": 0.2}], output=tmp_path / "out", quiet=True)
    runs = [open_result(tmp_path / "out" / f"{number:04d}") for number in range(4)]
    assert labels_of(runs[:2]) == ["step = 10 ms", "step = 20 ms"]
    assert labels_of(runs[:3]) == [
        "step = 10 ms, end = 100 ms",
        "step = 20 ms, end = 100 ms",
        "step = 10 ms, end = 200 ms",
    ]
    assert labels_of(runs[2:]) == ["0002", "0003"]
    assert labels_of([runs[0], runs[0]])[0].startswith("0: ")
    (tmp_path / "out" / "sweep.csv").unlink()
    assert labels_of(runs[:2]) == ["0000", "0001"]


@pytest.mark.slow
def test_vectors_are_columns_of_their_components(rod, tmp_path):
    asked = ["wall/wall/force", "probe/tip/position[0].x", "kinetic_energy"]
    of_plots = {"peak": "peak_wall/wall/force", "last": "probe/tip/position.x", "moved": "probe/tip/displacement.norm"}
    vary = {"initial.velocity": [(1.0, 0.0, 0.0), (0.2, 0.0, 0.0)], "time.end": [0.3]}  # the first one fails
    results = {name: name for name in asked} | of_plots
    table = sweep(rod, vary, results=results, output=tmp_path / "out", quiet=True)
    assert list(table)[-8:] == [*(f"wall/wall/force.{axis}" for axis in "xyz"), *asked[1:], *of_plots]
    assert table["last"][1] == table["probe/tip/position[0].x"][1]
    assert table["moved"][1] == pytest.approx(abs(table["last"][1] - 1.0))
    assert table["peak"][1] == peak_force(open_result(tmp_path / "out" / "0001"), "wall/wall/force")[0] > 0.0
    history = open_result(tmp_path / "out" / "0001").history
    assert table["wall/wall/force.x"][1] == history["wall/wall/force"][-1, 0] and np.isnan(
        table["wall/wall/force.x"][0]
    )
    assert table["probe/tip/position[0].x"][1] == history["probe/tip/position"][-1, 0, 0]
    chosen = table.where([velocity == [0.2, 0.0, 0.0] for velocity in table["initial.velocity"]])
    assert chosen["run"].tolist() == [1]
    rows = list(csv.DictReader((tmp_path / "out" / "sweep.csv").open()))
    assert rows[1]["initial.velocity"] == "[0.2, 0.0, 0.0]"
    assert float(rows[1]["wall/wall/force.x"]) == table["wall/wall/force.x"][1]
    for name, told in (
        ("probe/tip/position[4].x", r"probe/tip/position has probe/tip/position\[0\].x"),
        ("peak_wall/wal/force", "no 'peak_wall/wal/force', did you mean 'peak_wall/wall/force'"),
        ("kinetic_energi", "history has no column 'kinetic_energi', did you mean 'kinetic_energy'"),
    ):
        with pytest.raises(InputError, match=told):
            sweep(rod, [{}], results={"w": name}, output=tmp_path / "wrong", quiet=True)
    assert not (tmp_path / "wrong").exists()


def test_tables(tmp_path):
    table = Table({"a": [1, 2], "b": [0.5, 1 / 3], "c": ["x", "<y>"], "d": [None, 1]})
    assert [values.dtype.kind for values in table.values()] == ["i", "f", "U", "O"]
    assert table.rows[1] == {"a": 2, "b": 1 / 3, "c": "<y>", "d": 1}
    assert table.to_structured()["b"][1] == 1 / 3
    assert table.to_csv(tmp_path / "a" / "t.csv").read_text().splitlines()[2] == f"2,{1 / 3!r},<y>,1"
    assert "<td>&lt;y&gt;</td>" in table._repr_html_() and str(table).splitlines()[0].split() == list("abcd")
    assert table.where(table["a"] > 1)["c"].tolist() == ["<y>"]
    arrays = Table({"a": [np.array([0.1, 2.0]), np.array([3.0, 4.0])]})
    assert arrays.to_csv(tmp_path / "arrays.csv").read_text().splitlines()[1] == '"[0.1, 2.0]"'
    with pytest.raises(KeyError, match="table has no column 'aa', did you mean 'a'"):
        table["aa"]
    with pytest.raises(InputError, match="column 'b' has 1 rows, expected 2"):
        Table({"a": [1, 2], "b": [1]})


@pytest.mark.thorough
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_loops_over_runs_keep_nothing_and_compile_nothing(tmp_path, integrator):
    """Neither objects nor files nor PETSc objects grow with the number of runs."""
    case = Case.load("rod_impact", ["time.end=0.03", f"time.integrator={integrator}"])

    def run(number):
        case.material["default"].density = 1.0 + 1e-3 * number
        with Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
            simulation.run()
        shutil.rmtree(tmp_path / "out")

    def held():
        gc.collect()
        return len(gc.get_objects()), len(os.listdir("/proc/self/fd")), len(outlive._ALIVE)

    for number in range(4):
        run(number)
    before = held()
    compiled = count_compiled()
    for number in range(16):
        run(number)
    after = held()
    assert count_compiled() == compiled
    assert after[1:] == before[1:]
    assert after[0] - before[0] < 64  # less than four for each run: there was one for each atexit function
