"""The scaling study's resumption, and the meshes and the bare loop of the comparison with peers."""

import json
import os
import subprocess
import sys
from pathlib import Path

import model as peers
import numpy as np
import pytest
from scaling import Point, noise_of, rows_of, run_point

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


def script(name, *options, mesh=""):
    """What a script of the comparison prints."""
    command = [sys.executable, str(SCRIPTS / "peers" / name), *map(str, options)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env={**os.environ, "PEER_MESH": mesh})
    assert done.returncode == 0, done.stderr
    return done


def driver(name, *options, mesh=""):
    """What a driver of the comparison reports."""
    done = script(name, *options, mesh=mesh)
    line = next(text for text in done.stdout.splitlines() if text.startswith("RESULT "))
    return json.loads(line.removeprefix("RESULT "))


def test_peers_lattice_is_the_generators():
    from pfem_petsc.mesh.generators import lattice

    points, bars = peers.lattice(3)
    slab = lattice.generate(lattice.Parameters(kind="cubic", cells=(3, 3, 3), pitch=peers.PITCH), 0, 1)

    def as_set(points, bars):
        places = np.round(points / peers.PITCH).astype(int)
        return {frozenset(map(tuple, places[ends])) for ends in bars}

    assert as_set(points, bars) == as_set(slab.points, slab.bars)
    assert len(bars) == len(slab.bars)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("mode", ["explicit", "explicit_contact"])
def test_bare_loop_moves_as_the_program_does(mode):
    ours, bare = (driver(name, 4, mode, 300) for name in ("run_ours.py", "run_bare_loop.py"))
    assert ours["top"] == pytest.approx(bare["top"], rel=1e-10)
    assert ours["bars"] == bare["bars"]


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["disordered", "irregular"])
def test_bare_loop_moves_other_meshes_as_the_program_does(tmp_path, kind):
    script("make_mesh.py", kind, 2000, tmp_path)
    mesh = str(tmp_path / "mesh.npz")
    ours, bare = (driver(name, 0, "explicit", 600, mesh=mesh) for name in ("run_ours.py", "run_bare_loop.py"))
    assert ours["top"] == pytest.approx(bare["top"], rel=1e-8)
    assert 1500 < ours["bars"] == bare["bars"] < 2500


@pytest.mark.thorough
@pytest.mark.slow
def test_implicit_operators_agree():
    tops = [driver("run_ours.py", 3, "implicit", 4, operator)["top"] for operator in ("matrix_free", "assembled")]
    assert tops[0] == pytest.approx(tops[1], rel=1e-8)


@pytest.mark.slow
def test_static_solvers_agree():
    tops = [driver("run_ours.py", 3, "static", 1, solver)["top"] for solver in ("mumps", "gamg")]
    assert tops[0] == pytest.approx(tops[1], rel=1e-8)
    assert tops[0] < 0.0  # the edges bulge outwards


def test_points_with_other_programs_beside_them_are_marked():
    quiet = {"step_s": 1.0, "best_s": 0.95, "bandwidth_alone": 1e10, "bandwidth_ratio": 1.3, "ranks": 2}
    assert noise_of(quiet, 1.1e10) == ""
    assert noise_of(quiet | {"step_s": 1.5}, 1e10) == "repeats differ 1.58 x"
    assert noise_of(quiet | {"bandwidth_alone": 6e9}, 1e10) == "one process had 0.60 x the best bandwidth"
    for ratio in (0.7, 2.6):  # two processes have neither less than one nor more than twice as much
        assert noise_of(quiet | {"bandwidth_ratio": ratio}, 1e10) == f"bandwidth ratio {ratio:.2f} of 2 processes"


def test_points_of_both_studies_share_runs():
    whole, part = (Point(study, "cubic", "explicit", "newmark", 1000, 1) for study in ("strong", "weak"))
    assert whole.file == part.file
    assert part._replace(ranks=2).file == whole._replace(size=2000, ranks=2).file != whole._replace(ranks=2).file


@pytest.mark.thorough
@pytest.mark.slow
def test_a_study_goes_on_where_it_stopped(tmp_path):
    point = Point("strong", "cubic", "explicit", "central_differences", 126, 1)
    launcher = "env pfem_ranks={ranks}"  # alone, without mpirun
    assert run_point(point, tmp_path, launcher, 0.02, 120.0) == "done"
    written = (tmp_path / point.file).stat().st_mtime_ns
    assert run_point(point, tmp_path, launcher, 0.02, 120.0) == "kept"
    assert (tmp_path / point.file).stat().st_mtime_ns == written
    missing = Point("strong", "cubic", "explicit", "no_such_scheme", 126, 1)
    assert "no_such_scheme" in run_point(missing, tmp_path, launcher, 0.02, 120.0)
    (row,) = rows_of([point, missing], tmp_path)
    assert (row["bars"], row["speedup"], row["efficiency"]) == (126, 1.0, 1.0)
    assert not list(tmp_path.glob("*.part"))
