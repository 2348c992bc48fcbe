"""The option --restart of the command line."""

import json
import re
import shutil
import zlib

import h5py
import numpy as np
import pytest
from helpers.stopped import rod, steps

from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import open_result
from pfem_petsc.restart import kept_arguments


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "rod"
    assert main(rod(folder)) == 0
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "rod")


def test_nothing_to_restart_from(tmp_path, capsys):
    words = rod(tmp_path / "new", "--restart")
    words.remove("--quiet")
    assert main(words) == 0
    assert "no checkpoint to restart from: starting from zero" in capsys.readouterr().out
    assert len(steps(tmp_path / "new")[0]) == 51


@pytest.mark.slow
@pytest.mark.parametrize("every", [0, 20])
def test_finished_run(tmp_path, capsys, every):
    words = rod(tmp_path / "done", f"--set=output.checkpoint_every={every}")
    words.remove("--quiet")
    assert main(words) == 0
    before = (tmp_path / "done" / "result.vtkhdf").read_bytes()
    capsys.readouterr()
    assert main([*words, "--restart"]) == 0
    said = capsys.readouterr().out
    way = "continues them" if every else "begins anew, as there is no checkpoint (output.checkpoint_every)"
    ended = (
        "finished already: the results have t = 500.0 ms (--set time.end=0.5 is in force); a later end, --set time.end"
    )
    assert said == f"{tmp_path / 'done'}: {ended}=..., {way}\n"
    assert (tmp_path / "done" / "result.vtkhdf").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["done"]


@pytest.mark.slow
def test_finished_run_of_another_case_is_moved_aside(tmp_path):
    folder = tmp_path / "done"
    assert main(rod(folder, "--set=output.checkpoint_every=0")) == 0
    assert main(rod(folder, "--restart", "--set", "output.checkpoint_every=0", "initial.velocity=[0.4,0,0]")) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["done", "done.1"]


@pytest.mark.slow
def test_longer_end_goes_on_without_gap_or_duplicate(copy, capsys):
    words = rod(copy, "--restart", "--set", "output.history_every=2", "solver.rtol=1e-8", end=0.9)
    words.remove("--quiet")
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "restart from" in said
    assert "step 50" in said
    for change in ("time.end: 0.5 -> 0.9", "output.history_every: 1 -> 2", "solver.rtol: 1e-09 -> 1e-08"):
        assert change in said
    rows, snapshots = steps(copy)
    np.testing.assert_array_equal(rows, [*range(51), *range(52, 91, 2)])
    np.testing.assert_array_equal(snapshots, range(0, 91, 10))
    assert (copy / "checkpoint.h5").is_file()
    assert (copy / "checkpoint-previous.h5").is_file()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("time.step=0.02", "time.step: 0.01 -> 0.02"),
        ("time.integrator=newmark", 'time.integrator: "central_differences" -> "newmark"'),
        ("mesh.elements=21", "mesh.elements: 20 -> 21"),
        ("wall.0.point=[1.06,0,0]", "wall[0].point: [1.05, 0.0, 0.0] -> [1.06, 0.0, 0.0]"),
        ("initial.velocity=[0.4,0,0]", "initial.velocity"),
        ("output.fields=['velocity']", "keep [output] fields unchanged"),
    ],
)
def test_other_case_is_refused(copy, change, text, capsys):
    before = {path.name: path.read_bytes() for path in copy.iterdir() if path.suffix in (".h5", ".vtkhdf")}
    assert main(rod(copy, "--restart", f"--set={change}", end=0.9)) == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("error:") == 1
    assert {name: (copy / name).read_bytes() for name in before} == before


@pytest.mark.slow
def test_missing_and_damaged_files(copy, capsys):
    assert main(rod(copy, "--restart", str(copy / "no.h5"), end=0.9)) == 2
    assert "no.h5: there is no such checkpoint" in capsys.readouterr().err
    damaged = bytearray((copy / "checkpoint.h5").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (copy / "checkpoint.h5").write_bytes(damaged)
    assert main(rod(copy, "--restart", end=0.9)) == 2
    said = capsys.readouterr().err
    assert "damaged" in said
    assert "checkpoint-previous.h5" in said
    # the way out that it names
    assert main(rod(copy, "--restart", str(copy / "checkpoint-previous.h5"), end=0.9)) == 0
    np.testing.assert_array_equal(steps(copy)[0], range(91))


@pytest.mark.slow
def test_mesh_file_that_changed(tmp_path, capsys):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0.1]])

    def write(points):
        with h5py.File(tmp_path / "mesh.h5", "w") as file:
            file["points"], file["bars"] = points, np.array([[0, 1], [1, 2]])

    write(points)
    (tmp_path / "case.toml").write_text(
        '[mesh]\nfile = "mesh.h5"\n[material.m]\nyoung_modulus = 1.0\ndensity = 1.0\n'
        '[section.s]\narea = 1.0\nmaterial = "m"\n[time]\nintegrator = "newmark"\nstep = 0.1\nend = 1.0\n'
        "[output]\ncheckpoint_every = 5\n"
    )
    words = [str(tmp_path / "case.toml"), "-o", str(tmp_path / "out"), "--quiet"]
    assert main(words) == 0
    write(points + [[0, 0, 0], [0, 0, 0], [0, 0, 1e-15]])
    assert main([*words, "--restart", "--set", "time.end=2.0"]) == 2
    assert "other nodes or bars" in capsys.readouterr().err


def test_state_of_another_version(copy, capsys):
    """A file that is whole, but whose state has another meaning."""
    from mpi4py import MPI

    from pfem_petsc.output.checkpoint import Checkpoint, write_checkpoint

    with Checkpoint(copy / "checkpoint.h5", MPI.COMM_SELF) as file:
        scalars, attributes = file.scalars, file.attributes
    write_checkpoint(copy / "checkpoint.h5", MPI.COMM_SELF, {}, scalars, {**attributes, "state_version": 0})
    assert main(rod(copy, "--restart", end=0.9)) == 2
    assert "version 0 of a run's state" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["probe", "bar_probe"])
def test_other_members_of_a_probe(tmp_path, capsys, kind):
    """As many as before, so that their rows would fit."""
    given = "node_set = 'one'" if kind == "probe" else "indices = [1]"
    file = tmp_path / "case.toml"
    file.write_text(
        '[mesh]\ngenerator = "rod"\nlength = 1.0\nelements = 4\n[material.m]\nyoung_modulus = 1.0\ndensity = 1.0\n'
        '[section.s]\narea = 1.0\nmaterial = "m"\n[time]\nintegrator = "newmark"\nstep = 0.1\nend = 1.0\n'
        "[node_set]\none.indices = [ 1 ]\ntwo.indices = [ 2 ]\n"
        f"[output]\ncheckpoint_every = 5\n[[output.{kind}]]\nname = 'a'\n{given}\n"
    )
    words = [str(file), "-o", str(tmp_path / "out"), "--quiet"]
    assert main(words) == 0
    file.write_text(file.read_text().replace("indices = [1]", "indices = [2]").replace("'one'", "'two'"))
    assert main([*words, "--restart", "--set", "time.end=2.0"]) == 2
    said = capsys.readouterr().err
    members = "nodes" if kind == "probe" else "bars"
    assert f"probe 'a': the {members} 1 of the file are now 2: restart with the same ones" in said


def test_another_folder_gets_results_from_the_checkpoint_on(copy, tmp_path):
    assert main(rod(tmp_path / "new", "--restart", str(copy / "checkpoint-previous.h5"), end=0.9)) == 0
    rows, snapshots = steps(tmp_path / "new")
    np.testing.assert_array_equal(rows, range(40, 91))
    np.testing.assert_array_equal(snapshots, range(40, 91, 10))


@pytest.mark.slow
def test_values_of_set_are_kept_by_a_restart(tmp_path, capsys):
    """But for those given anew; the case file may lack what was given then."""
    (tmp_path / "case.toml").write_text(
        '[mesh]\ngenerator = "rod"\nlength = 1.0\nelements = 4\n[material.m]\nyoung_modulus = 1.0\ndensity = 1.0\n'
        '[section.s]\narea = 1.0\nmaterial = "m"\n[time]\nintegrator = "newmark"\nend = 0.4\n'
    )
    words = [str(tmp_path / "case.toml"), "-o", str(tmp_path / "out")]
    assert main([*words, "--quiet", "--set", "time.step=0.1", "time.end=1.0", "output.checkpoint_every=5"]) == 0
    assert main([*words, "--restart"]) == 0
    assert "finished already: the results have t = 1.000 s (--set time.end=1.0 is in force)" in capsys.readouterr().out
    assert main([*words, "--restart", "--set", "time.end=2.0"]) == 0
    said = capsys.readouterr().out
    assert "as in the run that is continued: --set time.step=0.1 output.checkpoint_every=5" in said
    assert "changed: time.end: 1.0 -> 2.0" in said
    with open_result(tmp_path / "out") as result:
        assert result.attributes["overrides"] == ["time.step=0.1", "output.checkpoint_every=5", "time.end=2.0"]
        np.testing.assert_array_equal(result.history["step"], range(21))
    # another model is refused as ever
    assert main([*words, "--restart", "--set", "time.step=0.2"]) == 2
    assert "time.step: 0.1 -> 0.2" in capsys.readouterr().err
    # what the file says is told, and what was set stays
    text = (tmp_path / "case.toml").read_text()
    (tmp_path / "case.toml").write_text(text.replace("end = 0.4", "end = 0.5") + "[solver]\nrtol = 1e-8\n")
    assert main([*words, "--restart", "--set", "time.end=2.5"]) == 0
    assert "changed: time.end: 2.0 -> 2.5; solver.rtol: 1e-09 -> 1e-08" in capsys.readouterr().out


def test_values_of_another_case_are_not_kept(copy):
    assert kept_arguments("rod_impact", copy, True) == (["output.checkpoint_every=20", "time.end=0.5"], [])
    assert kept_arguments("pendulum", copy, True) == ([], [])
    for path in copy.glob("*.h5"):
        path.unlink()
    assert kept_arguments("rod_impact", copy, True) == (["output.checkpoint_every=20", "time.end=0.5"], [])
    assert kept_arguments("pendulum", copy, True) == ([], [])


@pytest.mark.slow
@pytest.mark.parametrize("fields_every", [10, 0])
def test_results_beyond_an_earlier_end_are_never_cut(tmp_path, capsys, fields_every):
    folder = tmp_path / "rod"
    more = f"--set=output.fields_every={fields_every}"
    assert main(rod(folder, more)) == 0
    # results and checkpoint of a run that was killed on its way
    with h5py.File(folder / "result.vtkhdf", "r+") as file:
        del file["case/text"]
        file["case/text"] = "not a case"
        file["case/text"].attrs["checksum"] = zlib.crc32(b"not a case")
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".h5", ".vtkhdf")}
    assert main(rod(folder, "--restart", str(folder / "checkpoint-previous.h5"), more, end=0.45)) == 2
    said = capsys.readouterr().err
    assert "the results reach t = 500.0 ms, beyond time.end = 450.0 ms" in said
    assert "5 rows of the history and 1 snapshots" in said
    assert "--set time.end=0.5" in said
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert [path.name for path in tmp_path.iterdir()] == ["rod"]


@pytest.mark.slow
def test_earlier_end_of_a_finished_run_says_what_there_is(copy, capsys):
    words = rod(copy, "--restart", end=0.3)
    words.remove("--quiet")
    assert main(words) == 0
    assert "the results have t = 500.0 ms, beyond time.end = 300.0 ms" in capsys.readouterr().out
    assert len(steps(copy)[0]) == 51


@pytest.mark.slow
def test_checkpoint_written_anew_between_set_up_and_start(copy):
    """Another run has continued the folder meanwhile: its rows would be cut."""
    from pfem_petsc import Case, Simulation

    late = Simulation(Case.load("rod_impact", ["time.end=0.9"]), output=copy, restart=True, quiet=True)
    assert main(rod(copy, "--restart", end=0.8)) == 0
    with pytest.raises(InputError, match="another run has overwritten this checkpoint"):
        late.run()
    np.testing.assert_array_equal(steps(copy)[0], range(81))


def test_checkpoint_says_what_it_was_written_by(copy):
    raw = (copy / "checkpoint.h5").read_bytes()
    assert raw.startswith(b"pfem_petsc checkpoint")
    with h5py.File(copy / "checkpoint.h5") as file:
        state = json.loads(file["state"][()])
    assert re.fullmatch(r"\d+\.\d+\.\d+.*|not installed", state["attributes"]["pfem_petsc"])
    assert state["attributes"]["case"]["mesh"]["elements"] == 20
    assert state["scalars"]["step"] == 50


@pytest.mark.slow
def test_folder_of_checkpoints_stands_for_its_newest(copy, tmp_path, capsys):
    new = tmp_path / "new"
    assert main(rod(new, "--restart", str(copy), end=0.6)) == 0
    assert steps(new)[0][[0, -1]].tolist() == [50, 60]
    (copy / "checkpoint.h5").unlink()
    assert main(rod(copy, "--restart", str(copy), end=0.6)) == 0  # continued in its own place
    np.testing.assert_array_equal(steps(copy)[0], range(61))
    assert main(rod(new, "--restart", str(tmp_path))) == 2
    assert f"{tmp_path}: there is no checkpoint in this folder" in capsys.readouterr().err
