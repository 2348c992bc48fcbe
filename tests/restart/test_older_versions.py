"""Files of runs of older versions, kept as they were written: results since 0.2 open, checkpoints are refused.

A rod of two bars flies towards a wall at 1 m/s and meets it after 10 steps of 1 µs; the run of 20 steps has snapshots
every 10 steps and a row of the history every 5. Files of 0.1.0 have no checksums, and are refused. The attribute
with the folder of the case was replaced.
"""

import lzma
from pathlib import Path

import numpy as np
import pytest

from pfem_petsc import Case, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError

FILES = Path(__file__).with_name("older_versions")
VERSIONS = {"0.2.0": 6}  # of the state in their checkpoints
GAP, SPEED, STEP = 1e-5, 1.0, 1e-6


def of_version(version, tmp_path):
    """The output folder of a run of this version."""
    made = tmp_path / version
    made.mkdir()
    for name in ("result.vtkhdf", "checkpoint.h5"):
        (made / name).write_bytes(lzma.decompress((FILES / f"{version}.{name}.xz").read_bytes()))
    return made


@pytest.mark.parametrize("version", VERSIONS)
def test_results_open(version, tmp_path):
    with open_result(of_version(version, tmp_path)) as result:
        assert result.attributes["pfem_petsc"] == version
        np.testing.assert_array_equal(result.steps, [0, 10, 20])
        np.testing.assert_allclose(result.times, STEP * result.steps, rtol=1e-12)
        np.testing.assert_array_equal(result.bars, [[0, 1], [1, 2]])
        start, end = result.positions(0), result.positions(-1)
        np.testing.assert_array_equal(start, [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])
        # the tip stops at the wall; the wave that comes from there has not reached the other end
        assert end[2, 0] == pytest.approx(1.0 + GAP, rel=1e-15)
        assert end[0, 0] == pytest.approx(20 * STEP * SPEED, rel=1e-5)
        strain = np.diff(end[:, 0]) / 0.5 - 1.0
        np.testing.assert_allclose(result.field("strain", -1), strain, atol=1e-15)
        np.testing.assert_allclose(result.field("stress", -1), 2e11 * strain, rtol=1e-9)
        history = result.history
        np.testing.assert_array_equal(history["step"], [0, 5, 10, 15, 20])
        assert history["kinetic_energy"][0] == pytest.approx(0.5 * 7800.0 * 1e-4 * SPEED**2, rel=1e-12)
        assert history["wall/stop/contacts"].tolist()[:2] == [0, 0]
        assert history["wall/stop/contacts"][-1] == 1
        assert result.table(["kinetic_energy"])["kinetic_energy"].tolist() == history["kinetic_energy"].tolist()


@pytest.mark.parametrize("version", VERSIONS)
def test_case_in_the_results_runs_and_moves_alike(version, tmp_path):
    result = open_result(of_version(version, tmp_path))
    (tmp_path / "again.toml").write_text(result.case_text)
    assert Case.load(tmp_path / "again.toml") == result.case
    assert main([str(tmp_path / "again.toml"), "-o", str(tmp_path / "again"), "--quiet"]) == 0
    np.testing.assert_allclose(open_result(tmp_path / "again").positions(-1), result.positions(-1), rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_info_verifies_the_results(version, tmp_path, capsys):
    assert main(["info", str(of_version(version, tmp_path)), "--verify"]) == 0
    assert "All values match their checksums" in capsys.readouterr().out


def test_results_without_checksums_are_refused(tmp_path):
    """The message names the version that wrote them, and the ways out."""
    with pytest.raises(
        InputError,
        match="result.vtkhdf: has no checksums: version 0.1.0 of pfem_petsc wrote it; run the case again, or read it "
        "with that version or ParaView",
    ):
        open_result(of_version("0.1.0", tmp_path))


@pytest.mark.parametrize("version", VERSIONS)
def test_checkpoints_are_refused(version, tmp_path, capsys):
    """With both versions of the format, and the ways out; the results stay as they are."""
    folder = of_version(version, tmp_path)
    case = tmp_path / "case.toml"
    case.write_text(open_result(folder).case_text)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main([str(case), "-o", str(folder), "--restart", "--set", "time.end=3e-5"]) == 2
    assert (
        "checkpoint.h5: has version 1 of the checkpoint format, this program reads 2: restart with the version of "
        "pfem_petsc that wrote it, or start without --restart"
    ) in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
