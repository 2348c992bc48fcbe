"""Curves: files, content, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.synthetic import SyntheticResult, ring, write_result
from PIL import Image

from pfem_petsc.energies import LOST, STORED, SUPPLIED
from pfem_petsc.errors import InputError
from pfem_petsc.post.chart import thinned, window_mean
from pfem_petsc.post.plot import balance_error, plot


@pytest.fixture
def result(tmp_path):
    return SyntheticResult(tmp_path / "result.vtkhdf", *ring())


def saturated(file) -> np.ndarray:
    """Pixels (n, 3) with a colour: curves, not axes and text."""
    picture = np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3).astype(int)
    return picture[np.ptp(picture, axis=1) > 60]


@pytest.mark.slow
def test_all_pictures_of_a_result_file(tmp_path):
    file = write_result(tmp_path)
    written = plot(file)
    assert [path.name for path in written] == ["energies.png", "momentum.png", "probes.png", "walls.png", "solver.png"]
    for path in written:
        assert path.parent == tmp_path and len(saturated(path)) > 500


def test_what_a_result_lacks_is_left_out(tmp_path, result):
    result.history = {name: values for name, values in result.history.items() if "/" not in name}
    names = [path.name for path in plot(result, tmp_path / "pictures")]
    assert names == ["energies.png", "momentum.png", "solver.png"]


def test_many_terms_that_are_zero_leave_the_width_to_the_curves(tmp_path, result):
    def size(picture):
        """Columns between the first and the last that have a curve, and columns of the picture."""
        pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
        coloured = np.flatnonzero((np.ptp(pixels, axis=2) > 60).sum(axis=0))
        return np.ptp(coloured), pixels.shape[1]

    zero = 0.0 * result.history["kinetic_energy"]
    result.history |= {name: zero for name in (*STORED, *LOST, *SUPPLIED) if name not in result.history}
    curves, picture = size(plot(result, tmp_path)[0])
    assert curves > 0.6 * picture


@pytest.mark.slow
def test_contact_has_no_panel_without_walls(tmp_path, result):
    result.history = {name: values for name, values in result.history.items() if "/" not in name}
    with_contact = Image.open(plot(result, tmp_path)[-1]).height
    result.history["active_contacts"] = 0 * result.history["active_contacts"]
    without = plot(result, tmp_path)[-1]
    assert without.name == "solver.png" and Image.open(without).height < with_contact


def test_a_picture_is_not_a_panel_of_another(tmp_path, result):
    """Without iterations, the nodes in contact with a single wall are in walls.png alone."""
    for name in ("newton_iterations", "linear_iterations"):
        result.history[name] = 0 * result.history[name]
    assert [path.name for path in plot(result, tmp_path)][-1] == "walls.png"
    other = 3 - result.history["active_contacts"]  # of two walls, the sum is in no other picture
    result.history["wall/other/force"], result.history["wall/other/contacts"] = result.history["wall/wall/force"], other
    result.history["active_contacts"] = result.history["active_contacts"] + other
    assert [path.name for path in plot(result, tmp_path)][-1] == "solver.png"


def test_pairs_and_constraints_have_pictures(tmp_path, result):
    force = result.history.pop("wall/wall/force")
    del result.history["wall/wall/contacts"]
    result.history |= {"pair/faces/force": force, "pair/a/b/force": force, "constraint/rope/force": force}
    written = {path.name: path for path in plot(result, tmp_path)}
    assert "walls.png" not in written
    assert Image.open(written["pairs.png"]).height > 1.5 * Image.open(written["constraints.png"]).height
    assert len(saturated(written["pairs.png"])) > 500


def test_walls_without_a_force_take_no_panels(tmp_path, result):
    alone = Image.open(plot(result, tmp_path / "alone")[-2])
    result.history[r"wall/far $\bad$/force"] = 0.0 * result.history["wall/wall/force"]
    result.history[r"wall/far $\bad$/contacts"] = 0 * result.history["wall/wall/contacts"]
    (written,) = (path for path in plot(result, tmp_path) if path.name == "walls.png")
    beside = Image.open(written)
    assert abs(beside.height - alone.height) < 20
    assert np.asarray(beside.convert("L")).size and beside.tobytes() != alone.tobytes()  # the note names it
    # nothing to show at all: the panels say so
    result.history["wall/wall/force"] = 0.0 * result.history["wall/wall/force"]
    assert "walls.png" in [path.name for path in plot(result, tmp_path)]


def test_named_curves(tmp_path, result):
    written = plot(result, tmp_path, curves=["kinetic_energy", "momentum", "probe/tip/velocity", "wall/wall/contacts"])
    assert [path.name for path in written] == ["curves.png"] and len(saturated(written[0])) > 500
    assert not (tmp_path / "energies.png").exists()


def test_unknown_curve_is_refused_with_the_nearest(tmp_path, result):
    with pytest.raises(InputError, match=r"no column 'kinetic_enrgy', did you mean 'kinetic_energy'\?"):
        plot(result, tmp_path, curves=["kinetic_enrgy"])
    with pytest.raises(InputError, match="no curves named"):
        plot(result, tmp_path, curves=[])


def test_empty_history_is_refused(tmp_path, result):
    result.history = {name: values[:0] for name, values in result.history.items()}
    with pytest.raises(InputError, match="history is empty"):
        plot(result, tmp_path)


@pytest.mark.slow
def test_one_row_is_enough(tmp_path, result):
    result.history = {name: values[:1] for name, values in result.history.items()}
    assert len(plot(result, tmp_path)) == 5


def test_folder_that_cannot_be_made_is_refused(tmp_path, result):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        plot(result, tmp_path / "file")


def test_balance_error_counts_supply_against_storage_and_loss():
    history = {
        "kinetic_energy": np.array([10.0, 6.0]),
        "elastic_energy": np.array([0.0, 3.0]),
        "plastic_dissipation": np.array([0.0, 2.0]),
        "external_work": np.array([0.0, 1.5]),
        "contact_work": np.array([0.0, -0.75]),
        "thermal_work": np.array([0.0, 4.0]),
    }
    assert balance_error(history) == pytest.approx([0.0, 6 + 3 + 2 - 1.5 + 0.75 - 4 - 10])


def test_thinned_curve_keeps_spikes_and_ends():
    time = np.linspace(0, 1, 100_003)
    values = np.sin(7 * time)
    values[54_321], values[77_777] = 50.0, -50.0
    short_time, short = thinned(time, values, 1000)
    assert len(short) < 1010 and np.all(np.diff(short_time) > 0)
    assert {50.0, -50.0, values[0], values[-1]} <= set(short)
    assert short_time[np.argmax(short)] == time[54_321]


def integral(values, time):
    return float(np.sum(0.5 * np.diff(time) * (values[1:] + values[:-1])))


def test_window_mean_keeps_the_impulse_of_uneven_steps():
    random = np.random.default_rng(1)
    time = np.cumsum(random.uniform(0.5e-3, 1.5e-3, 400))
    values = np.where(np.abs(time - time[200]) < 0.05, random.uniform(0, 2e3, 400), 0.0)
    smooth = window_mean(time, values, 0.03)
    assert integral(smooth, time) == pytest.approx(integral(values, time), rel=2e-3)
    assert smooth.max() < 0.8 * values.max()
    line = 3.0 * time - 1.0
    inner = slice(50, 350)
    # of the time before each point
    assert window_mean(time, line, 0.03)[inner] == pytest.approx(line[inner] - 3.0 * 0.015, rel=1e-9, abs=1e-12)


def test_window_mean_does_not_rise_before_its_cause():
    time = np.linspace(0.0, 1.0, 101)
    values = np.where(time > 0.5, 1.0, 0.0)
    assert not window_mean(time, values, 0.1)[time <= 0.5].any()


def test_curves_of_an_earlier_call_stay(tmp_path, result):
    (first,) = plot(result, tmp_path, curves=["kinetic_energy"])
    (second,) = plot(result, tmp_path, curves=["momentum"])
    assert [first.name, second.name] == ["curves.png", "curves_2.png"]


def test_characters_that_the_font_lacks_are_boxes_without_a_warning(tmp_path, result, recwarn):
    result.case.title = "a wall of 壁"
    plot(result, tmp_path, curves=["kinetic_energy"])
    assert not [str(warning.message) for warning in recwarn if "Glyph" in str(warning.message)]


@pytest.mark.slow
def test_titles_are_no_formulas(tmp_path, result):
    result.case.title = r"a force of $\frac{1}$ N"
    assert len(plot(result, tmp_path)) == 5
