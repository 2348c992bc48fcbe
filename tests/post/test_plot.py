"""Curves: files, content, refusals."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.synthetic import SyntheticResult, ring, write_result
from PIL import Image

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.energies import LOST, STORED, SUPPLIED
from pfem_petsc.errors import InputError
from pfem_petsc.post.chart import COLOURS, thinned
from pfem_petsc.post.closed_forms import closed_form
from pfem_petsc.post.energies import balance_error
from pfem_petsc.post.filters import cfc, window_mean
from pfem_petsc.post.plot import plot


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
    assert [path.name for path in written] == [
        "energies.png",
        *("momentum.png", "probes.png", "walls.png", "force_displacement.png", "solver.png"),
    ]
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
    assert [path.name for path in plot(result, tmp_path)][-2:] == ["walls.png", "force_displacement.png"]
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
    assert len(plot(result, tmp_path)) == 6


def test_formats_and_tables(tmp_path, result):
    written = plot(result, tmp_path, curves=["kinetic_energy", "wall/wall/force"], formats=["svg", "pdf", "csv"])
    assert [path.name for path in written] == ["curves.svg", "curves.pdf", "curves.csv"]
    assert written[0].read_text().startswith("<?xml") and written[1].read_bytes().startswith(b"%PDF")
    head, *rows = csv.reader(written[2].open())
    assert head == ["time [s]", "kinetic_energy [J]", "wall/wall/force.x [N]"] and len(rows) == len(
        result.history["time"]
    )
    table = np.array(rows, dtype=float)
    assert np.array_equal(table[:, 1], result.history["kinetic_energy"])
    assert np.array_equal(table[:, 2], result.history["wall/wall/force"][:, 0])
    (second,) = plot(result, tmp_path, curves=["momentum"], formats=["csv"])
    assert second.name == "curves_2.csv"


def test_stored_and_lost_energies_fill_what_was_supplied(tmp_path, result):
    """The picture's table has the sums that its areas and its line show."""
    result.history["external_work"] = np.linspace(0.0, 7.0, len(result.history["time"]))
    plot(result, tmp_path, formats=["csv"])
    table = dict(zip(*_columns(tmp_path / "energies.csv"), strict=True))
    stored = result.history["kinetic_energy"] + result.history["elastic_energy"]
    assert table["stored and lost [J]"] == pytest.approx(stored)
    assert table["at the start and supplied [J]"] == pytest.approx(stored[0] + result.history["external_work"])


def _columns(path):
    head, *rows = csv.reader(path.open())
    return head, np.array(rows, dtype=float).T


def test_forces_over_displacements(tmp_path, result):
    (file,) = plot(result, tmp_path, curves=["wall/wall/force.x"], against="centre_of_mass.x", formats=["csv"])
    head, (place, force) = _columns(file)
    assert head == ["centre_of_mass.x [m]", "wall/wall/force.x [N]"]
    assert np.array_equal(place, result.history["centre_of_mass"][:, 0])
    assert np.array_equal(force, result.history["wall/wall/force"][:, 0])
    with pytest.raises(
        InputError, match=r"against = 'centre_of_mass' is a vector: name a component, centre_of_mass\.x"
    ):
        plot(result, tmp_path, curves=["kinetic_energy"], against="centre_of_mass")


def test_filter_of_forces_is_named(tmp_path, result):
    plot(result, tmp_path, force_filter="cfc:60", formats=["csv"])
    head, columns = _columns(tmp_path / "walls.csv")
    (k,) = (k for k, name in enumerate(head) if "CFC 60 of SAE J211-1 (two passes, −3 dB at 100 Hz)" in name)
    raw = result.history["wall/wall/force"] @ np.array([-1.0, 0.0, 0.0])
    assert columns[k] == pytest.approx(cfc(result.history["time"], raw, 60.0))


def test_several_results_are_drawn_over_each_other(tmp_path, result):
    other = SyntheticResult(tmp_path / "fine" / "result.vtkhdf", *ring(), snapshots=5)
    (file,) = plot([result, other], tmp_path / "both", formats=["csv"])
    assert file.name == "comparison.csv"
    head, *rows = csv.reader(file.open())
    here = tmp_path.name
    assert [head[0], head[2]] == [f"time [s]: {here}", "time [s]: fine"]
    assert head[1] == f"kinetic_energy: {here} [J]" and head[3] == "kinetic_energy: fine [J]"
    assert len(rows) == 260 and [bool(row[3]) for row in rows].count(True) == 100
    (picture,) = plot([result, other], tmp_path / "both")
    assert len(saturated(picture)) > 500


def test_spectra_have_the_amplitude(tmp_path, result):
    time = result.history["time"]
    result.history["probe/tip/velocity"] = np.zeros((len(time), 1, 3))
    frequency = 20 / (time[-1] * len(time) / (len(time) - 1))
    result.history["probe/tip/velocity"][:, 0, 1] = 3.0 * np.sin(2 * np.pi * frequency * time)
    (file,) = plot(result, tmp_path, spectrum=["probe/tip/velocity"], formats=["csv"])
    assert file.name == "spectra.csv"
    head, (places, amplitude) = _columns(file)
    assert head == ["frequency [Hz]", "probe/tip/velocity.y [m/s]"]
    assert places[20] == pytest.approx(frequency) and amplitude.argmax() == 20 and amplitude[20] == pytest.approx(3.0)
    assert len(saturated(plot(result, tmp_path, spectrum=["probe/tip/velocity"])[0])) > 300


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"formats": ["jpg"]}, "format = 'jpg' is not known; it is one of png, svg, pdf, csv"),
        ({"force_filter": "cfc"}, "filter = 'cfc' is not known; give cfc:CLASS"),
        ({"force_filter": "butterworth:-3"}, "is not known; give"),
        ({"force_filter": "cfc:6000"}, "needs more than 2.49e[+]04 rows of the history per second"),
        ({"force_filter": "cfc:1"}, "is slower than the history of 50.00 ms"),
        ({"spectrum": ["momentum.x"], "window": "hanning"}, "window = 'hanning' is not known"),
        ({"spectrum": ["momentum.x"], "curves": ["time"]}, "picture of its own"),
        ({"against": "momentum.x"}, "against = 'momentum.x' needs curves"),
        ({"curves": ["kinetic_energy.x"]}, "is a number and has no components"),
        ({"spectrum": ["momentun.x"]}, "no column 'momentun', did you mean 'momentum'"),
        ({"spectrum": ["momentum.x"], "highest": -1.0}, "must be positive"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_options_that_do_not_work_are_refused(tmp_path, result, options, message):
    with pytest.raises(InputError, match=message):
        plot(result, tmp_path, **options)
    assert not list(tmp_path.glob("*.png")) or "force_filter" in options


def test_colours_are_told_apart_by_colour_blind_eyes():
    """Distances of the first six colours as seen without red or green cones (Viénot, Brettel and Mollon 1999)."""
    from matplotlib.colors import to_rgb

    rgb = np.array([to_rgb(colour) for colour in COLOURS[:6]])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    protan = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    deutan = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    for seen in (linear, linear @ protan.T, linear @ deutan.T):
        seen = np.clip(seen, 0.0, 1.0) ** (1 / 2.4)
        apart = np.linalg.norm(seen[:, None] - seen[None], axis=2)
        assert apart[~np.eye(6, dtype=bool)].min() > 0.1


def test_results_over_load_factors_are_not_over_time(tmp_path):
    """The times of a static analysis are load factors, and its force-displacement curve has the closed form."""
    with Simulation(Case.load("von_mises"), output=tmp_path / "r", quiet=True) as simulation:
        simulation.run()
    written = {path.name: path for path in plot(tmp_path / "r", formats=["csv"])}
    assert _columns(written["energies.csv"])[0][0] == "point"
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


def test_python_of_the_page_runs(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "plotting.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    with Simulation(Case.load("rod_impact"), output="results/rod_impact", quiet=True) as simulation:
        simulation.run()
    found = {}
    exec(code, found)
    # the plateau of the filtered force is rho c A v
    time, force = np.asarray(found["history"]["time"]), found["force"]
    assert force[(time > 0.8) & (time < 1.6)] == pytest.approx(0.5, rel=0.02)
    assert found["frequency"][-1] == pytest.approx(250 / 5.01)
    assert (tmp_path / "pictures" / "rod.html").is_file() and (tmp_path / "pictures" / "walls.svg") in [
        path.absolute() for path in found["files"]
    ]
