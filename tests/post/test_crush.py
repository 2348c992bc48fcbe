"""Figures of crush tests: of curves known in closed form, and of a pressed lattice against the work of its wall."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.post import crush as module
from pfem_petsc.post.crush import crush


def block(strain, stress, **more):
    """A result of a block of 2 m2 x 0.5 m that a wall presses along -y, after a gap of 0.1 m."""
    way = np.concatenate([[0.0, 0.1], 0.1 + 0.5 * np.asarray(strain)[1:]])
    force = 2.0 * np.concatenate([[0.0], stress])
    y = np.array([0.0, 1.0, 0.0])
    return SimpleNamespace(
        path="out",
        history={"wall/w/position": np.outer(-way, y), "wall/w/force": np.outer(-force, y), "load_factor": way, **more},
        case=SimpleNamespace(every_wall=[SimpleNamespace(name="w")]),
        positions=lambda _: np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 2.0]]),
    )


def figures(result, monkeypatch, **options):
    monkeypatch.setattr(module, "_mass", lambda _: 5.0)
    return {row["figure"]: row["value"] for row in crush(result, "w", **options).figures().rows}


def test_plateau_and_densification(monkeypatch):
    """To 10 MPa at 2 %, constant to 50 %, to 100 MPa at 60 %."""
    strain = np.linspace(0.0, 0.6, 6001)
    stress = np.interp(strain, [0.0, 0.02, 0.5, 0.6], [0.0, 10e6, 10e6, 100e6])
    found = figures(block(strain, stress), monkeypatch, window=0.0)
    assert (found["area"], found["height"]) == pytest.approx((2.0, 0.5))
    assert found["plateau stress (20 to 40 %)"] == pytest.approx(10e6, rel=1e-9)
    assert found["strain at the end of the plateau"] == pytest.approx(0.5 + 0.1 * 3.0 / 90.0, abs=2e-4)
    assert found["energy by volume to 50 %"] == pytest.approx(10e6 * 0.49, rel=1e-9)
    assert found["energy by mass to 50 %"] == pytest.approx(10e6 * 0.49 / 5.0, rel=1e-9)
    assert found["densification strain"] == pytest.approx(0.5, abs=2e-4)
    assert found["largest efficiency"] == pytest.approx(0.49, rel=1e-3)
    assert found["energy of the test"] == pytest.approx(10e6 * 0.49 + 55e6 * 0.1, rel=1e-6)
    assert np.isnan(found["first peak"])
    mean = figures(block(strain, stress), monkeypatch)
    assert mean["plateau stress (20 to 40 %)"] == pytest.approx(10e6, rel=1e-9)
    other = figures(block(strain, stress), monkeypatch, area=1.0, height=0.5)
    assert other["plateau stress (20 to 40 %)"] == pytest.approx(20e6, rel=1e-9)


def test_first_peak_is_the_mean_over_the_window(monkeypatch):
    """A triangle up to 8 MPa at 10 %, down to 5 MPa at 16 %: the mean over 2 % at its top is 8 - (80 + 50)/2 0.01/2."""
    strain = np.linspace(0.0, 0.3, 30001)
    stress = np.interp(strain, [0.0, 0.1, 0.16, 0.3], [0.0, 8e6, 5e6, 5e6])
    found = figures(block(strain, stress), monkeypatch, window=0.02)
    up, down = 80e6, 50e6  # slopes; the window that has the largest mean begins and ends at the same stress
    assert found["first peak"] == pytest.approx(8e6 - 0.5 * 0.02 / (1.0 / up + 1.0 / down), rel=1e-4)
    assert np.isnan(found["plateau stress (20 to 40 %)"])
    assert np.isnan(found["energy by volume to 50 %"])
    assert figures(block(strain, stress), monkeypatch, window=0.0)["first peak"] == pytest.approx(8e6, rel=1e-9)


def test_both_ends_of_the_curve_are_those_of_the_rows(monkeypatch):
    """And the mean over a window about any point of a line is the line."""
    monkeypatch.setattr(module, "_mass", lambda _: 5.0)
    strain = np.linspace(0.0, 0.3, 3001)
    test = crush(block(strain, 2e6 * strain), "w", window=0.02)
    np.testing.assert_allclose(test.stress, 2e6 * test.strain, rtol=1e-4, atol=1e-6)
    assert (test.stress[0], test.stress[-1]) == pytest.approx((0.0, 0.6e6), rel=1e-9)


def test_displacements_that_are_no_lengths():
    strain = np.linspace(0.0, 0.3, 31)
    result = block(strain, 1e6 * strain, kinetic_energy=np.ones(32))
    with pytest.raises(InputError, match="kinetic_energy is in J: expected a length in m"):
        crush(result, "w", displacement="kinetic_energy")
    with pytest.raises(InputError, match="is no number in 1 rows"):
        crush(result, "w", displacement="wall/w/position.y/wall/w/position.y*1[m]")


def test_a_peak_within_the_window_is_told_and_not_guessed(monkeypatch):
    """A strut that buckles at a strain of 0.1 %: 8 MPa, of which a mean over 1 % knows nothing."""
    strain = np.linspace(0.0, 0.3, 30001)
    result = block(strain, np.interp(strain, [0.0, 0.001, 0.004, 0.3], [0.0, 8e6, 2e6, 2e6]))
    found = figures(result, monkeypatch)
    assert np.isnan(found["first peak"]) and np.isnan(found["strain at the first peak"])
    assert "give a smaller window, 0 for the rows" in crush(result, "w").remarks()[0]
    rows = crush(result, "w", window=0.0)
    assert figures(result, monkeypatch, window=0.0)["first peak"] == pytest.approx(8e6, rel=1e-9)
    assert rows.remarks() == []


def test_end_of_the_plateau_is_between_rows(monkeypatch):
    """Rows at every 3 % of strain: 10 MPa to 42 %, then 100 MPa more over 10 %, 13 MPa at 42.3 %."""
    strain = np.arange(0.0, 0.6, 0.03)
    stress = np.interp(strain, [0.0, 1e-6, 0.42, 0.52, 0.6], [0.0, 10e6, 10e6, 110e6, 190e6])
    found = figures(block(strain, stress), monkeypatch, window=0.0)
    assert found["strain at the end of the plateau"] == pytest.approx(0.423, abs=1e-9)


@pytest.mark.parametrize(
    ("wall", "options", "text"),
    [
        ("plate", {}, "there is no wall 'plate'"),
        ("w", {"area": -1.0}, "area = -1: expected a number > 0"),
        ("w", {"window": 0.5}, "window = 0.5"),
        ("w", {"displacement": "probe/top/position.z"}, "probe/top/position"),
    ],
)
def test_refused(wall, options, text):
    strain = np.linspace(0.0, 0.3, 31)
    with pytest.raises(InputError, match=text):
        crush(block(strain, 1e6 * strain), wall, **options)


def test_walls_that_touch_nothing_or_stand():
    strain = np.linspace(0.0, 0.3, 31)
    with pytest.raises(InputError, match="is not touched"):
        crush(block(strain, 0.0 * strain), "w")
    result = block(strain, 1e6 * strain)
    del result.history["wall/w/position"]
    with pytest.raises(InputError, match="does not move: give the component"):
        crush(result, "w")


@pytest.mark.slow
def test_pressed_lattice(tmp_path, capsys):
    """The energy is the work of the plate; the command and the report show the same figures."""
    motion = "wall.0.motion=[[0.0,0.0,0.0,0.0],[1.0,0.0,0.0,-2e-3],[1.25,0.0,0.0,-1.9e-3]]"
    changes = ["mesh.cells=[2,2,2]", "node_set.beside.nearest=[0.02,0.0,0.0]", "wall.0.point=[0.0,0.0,0.02]", motion]
    with Simulation(Case.load("octet_compression", changes), MPI.COMM_SELF, output=tmp_path, quiet=True) as simulation:
        simulation.run()
    test = crush(tmp_path, "plate")
    history = open_result(tmp_path).history
    assert (test.area, test.height) == pytest.approx((4e-4, 0.02))
    assert test.strain[-1] == pytest.approx(0.1)
    assert test.energy[-1] * test.area * test.height == pytest.approx(history["contact_work"].max(), rel=1e-3)
    files = [str(tmp_path / name) for name in ("crush.csv", "crush.png")]
    assert main(["crush", str(tmp_path), "--wall", "plate", "--csv", files[0], "--picture", files[1]]) == 0
    told = capsys.readouterr().out
    assert "none" in told
    assert [name in told for name in files] == [True, True]
    assert main(["report", str(tmp_path), "--no-pictures"]) == 0
    report = (tmp_path / "report.html").read_text()
    assert "Crush tests" in report
    assert "plateau stress (20 to 40 %)" in report
    assert main(["crush", str(tmp_path), "--wall", "plat"]) == 2
    assert "did you mean 'plate'" in capsys.readouterr().err
