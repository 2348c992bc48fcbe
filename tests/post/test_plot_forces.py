"""Curves of forces: panels, filters, closed forms, over displacements."""

from __future__ import annotations

import csv
import re
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pictures import saturated, table_columns
from helpers.synthetic import SyntheticResult, ring
from PIL import Image

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.output.units import common_prefix
from pfem_petsc.post.curves import cfc, closed_form, window_mean
from pfem_petsc.post.plot import plot


@pytest.fixture
def result(tmp_path):
    return SyntheticResult(tmp_path / "result.vtkhdf", *ring())


@pytest.mark.slow
def test_pairs_and_constraints_have_pictures(tmp_path, result):
    force = result.history.pop("wall/wall/force")
    del result.history["wall/wall/contacts"]
    result.history |= {"pair/faces/force": force, "pair/a/b/force": force, "constraint/rope/force": force}
    written = {path.name: path for path in plot(result, tmp_path)}
    assert "walls.png" not in written
    assert Image.open(written["pairs.png"]).height > 1.5 * Image.open(written["constraints.png"]).height
    assert len(saturated(written["pairs.png"])) > 500


@pytest.mark.slow
def test_walls_without_a_force_take_no_panels(tmp_path, result):
    alone = Image.open(next(path for path in plot(result, tmp_path / "alone") if path.name == "walls.png"))
    result.history[r"wall/far $\bad$/force"] = 0.0 * result.history["wall/wall/force"]
    result.history[r"wall/far $\bad$/contacts"] = 0 * result.history["wall/wall/contacts"]
    (written,) = (path for path in plot(result, tmp_path) if path.name == "walls.png")
    beside = Image.open(written)
    assert abs(beside.height - alone.height) < 20
    assert np.asarray(beside.convert("L")).size and beside.tobytes() != alone.tobytes()  # the note names it
    # nothing to show at all: the panels say so
    result.history["wall/wall/force"] = 0.0 * result.history["wall/wall/force"]
    assert "walls.png" in [path.name for path in plot(result, tmp_path)]


def test_filter_of_forces_is_named(tmp_path, result):
    plot(result, tmp_path, force_filter="cfc:60", formats=["csv"])
    head, columns = table_columns(tmp_path / "walls.csv")
    (k,) = (k for k, name in enumerate(head) if "CFC 60 of SAE J211-1 (two passes, −3 dB at 100 Hz)" in name)
    raw = result.history["wall/wall/force"] @ np.array([-1.0, 0.0, 0.0])
    assert columns[k] == pytest.approx(cfc(result.history["time"], raw, 60.0, zero_before=True))


@pytest.mark.slow
def test_results_over_load_factors_are_not_over_time(tmp_path):
    """The times of a static analysis are load factors, and its force-displacement curve has the closed form."""
    with Simulation(Case.load("von_mises"), output=tmp_path / "r", quiet=True) as simulation:
        simulation.run()
    written = {path.name: path for path in plot(tmp_path / "r", formats=["csv"])}
    assert table_columns(written["energies.csv"])[0][0] == "point"
    head, *rows = csv.reader(written["force_displacement.csv"].open())
    assert head[0] == "displacement along −z [m]" and head[3].endswith("closed form")
    exact = np.array([row[2:] for row in rows], dtype=float)
    for place, factor in ([float(value) for value in row[:2]] for row in rows if row[0]):
        assert np.interp(place, *exact.T) == pytest.approx(factor, abs=2e-4)
    with pytest.raises(InputError, match="needs a run over time"):
        plot(tmp_path / "r", force_filter="cfc:60")
    with pytest.raises(InputError, match="spectra need a run over time"):
        plot(tmp_path / "r", spectrum=["load_factor"])


def test_closed_form_of_the_rod(tmp_path):
    """Computed curves converge to it: mean differences of a fine rod from the wave solution."""
    overrides = ["mesh.elements=50", "output.fields_every=0"]
    with Simulation(Case.load("rod_impact", overrides), output=tmp_path, quiet=True) as simulation:
        simulation.run()
    with open_result(tmp_path) as result:
        exact = closed_form(result)
        scales = {"wall/wall/force": 0.5, "kinetic_energy": 0.125, "elastic_energy": 0.125, "momentum": 0.5}
        scales |= {"centre_of_mass": 1.0, "probe/tip/position": 1.0, "probe/tip/velocity": 0.5}
        assert set(exact.columns) == set(scales)
        for name, scale in scales.items():
            difference = np.abs(exact.columns[name] - result.history[name])
            assert difference.mean() < 0.03 * scale, name
        # a wall that moves, gravity or damping: another problem
        case = result.case
        case.gravity = {"acceleration": [0.0, 0.0, -1.0]}
        moved = SimpleNamespace(case=case, history=result.history, positions=result.positions, times=result.times)
        assert closed_form(moved) is None


@pytest.mark.slow
def test_forces_of_a_picture_have_one_unit(tmp_path, result):
    """1.6 kN as computed, less than 1 kN filtered, and a second wall with 40 N."""
    result.history["wall/wall/force"] = result.history["wall/wall/force"] * (1600.0 / 54e3)
    result.history["wall/far/force"] = result.history["wall/wall/force"] / 40.0
    written = {path.name: path for path in plot(result, tmp_path, formats=["svg"])}
    assert set(re.findall(r">([a-z ]*force \[\w+\])<", written["walls.svg"].read_text())) == {
        *("normal force [kN]", "force [kN]"),
    }
    assert common_prefix([2e6, 30.0], "N") == (1e-3, "kN")
    assert common_prefix([2e6, 1e-8, 0.0], "N") == (1e-6, "MN")
    assert common_prefix([0.02, np.nan], "m") == (1e3, "mm")


def test_forces_over_displacements_begin_at_the_contact(tmp_path, result):
    """Not the flight to the wall and back: the displacement is that since the contact."""
    result.history["centre_of_mass"] = result.history["centre_of_mass"] + 5.0
    plot(result, tmp_path, formats=["csv"], force_filter="none")
    head, (place, force) = table_columns(tmp_path / "force_displacement.csv")
    assert head[0] == "displacement of the centre of mass since contact [m]"
    time = result.history["time"]
    touching = np.flatnonzero(result.history["wall/wall/force"].any(axis=1))
    rows = slice(touching[0] - 1, touching[-1] + 2)
    assert 5 < len(touching) < 0.8 * len(time)
    assert place == pytest.approx(-(time[rows] - time[touching[0] - 1]))
    assert force == pytest.approx(-result.history["wall/wall/force"][rows, 0])


@pytest.mark.slow
def test_closed_forms_pass_the_filter_of_the_forces(tmp_path):
    """Beside filtered forces stands the filtered wave force, and beside those as computed, the step itself."""
    with Simulation(Case.load("rod_impact"), output=tmp_path / "r", quiet=True) as simulation:
        simulation.run()
    plot(tmp_path / "r", tmp_path, formats=["csv"], force_filter="mean:0.5")
    head, columns = table_columns(tmp_path / "walls.csv")
    exact = [values for name, values in zip(head, columns, strict=True) if "closed form" in name]
    assert len(exact) == 2 and set(np.unique(exact[0])) == {0.0, exact[0].max()}
    smooth = window_mean(columns[0], exact[0], 0.5, True)
    assert exact[1] == pytest.approx(smooth, abs=1e-12) and np.abs(smooth - exact[0]).max() > 0.3 * exact[0].max()
