"""Curves: files, content, refusals."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.synthetic import SyntheticResult, ring, write_result
from PIL import Image

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import balance_error
from pfem_petsc.post.chart import Chart
from pfem_petsc.post.plot import plot, solver


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
    names = [path.name for path in plot(result, tmp_path / "pictures", formats=["csv"])]
    assert names == ["energies.csv", "momentum.csv", "solver.csv"]


def test_a_picture_is_not_a_panel_of_another(tmp_path, result):
    """Without iterations, the nodes in contact with a single wall are in walls.png alone."""
    for name in ("newton_iterations", "linear_iterations"):
        result.history[name] = 0 * result.history[name]
    written = plot(result, tmp_path, formats=["csv"])
    assert [path.name for path in written][-2:] == ["walls.csv", "force_displacement.csv"]
    other = 3 - result.history["active_contacts"]  # of two walls, the sum is in no other picture
    result.history["wall/other/force"], result.history["wall/other/contacts"] = result.history["wall/wall/force"], other
    result.history["active_contacts"] = result.history["active_contacts"] + other
    assert plot(result, tmp_path, formats=["csv"])[-1].name == "solver.csv"


def test_iterations_are_drawn_over_the_step_that_needed_them(result):
    """And nodes in contact from their row on."""
    result.history["wall/other/contacts"] = result.history["active_contacts"]  # so that the sum is not with the walls
    chart = Chart(solver(result), "t", result.history["time"])
    drawn = {axes.get_ylabel(): axes.lines[0].get_drawstyle() for axes in chart.axes}
    steps = {"newton iterations": "steps-pre", "linear iterations": "steps-pre", "active contacts": "steps-post"}
    assert drawn == steps


def test_empty_history_is_refused(tmp_path, result):
    result.history = {name: values[:0] for name, values in result.history.items()}
    with pytest.raises(InputError, match="history is empty"):
        plot(result, tmp_path)


@pytest.mark.slow
def test_one_row_is_enough(tmp_path, result):
    """Its numbers are points, which are seen."""
    result.history = {name: values[:1] for name, values in result.history.items()}
    names = [path.stem for path in plot(result, tmp_path, formats=["csv"])]
    assert names == ["energies", "momentum", "probes", "walls", "solver"]
    assert len(saturated(plot(result, tmp_path)[1])) > 20
    result.history["momentum"] = 0.0 * result.history["momentum"]
    assert "momentum" not in [path.stem for path in plot(result, tmp_path, formats=["csv"])]


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


def test_characters_that_the_font_lacks_are_boxes_without_a_warning(tmp_path, result, recwarn):
    result.case.title = "a wall of 壁"
    plot(result, tmp_path, curves=["kinetic_energy"])
    assert not [str(warning.message) for warning in recwarn if "Glyph" in str(warning.message)]


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"formats": ["jpg"]}, "format = 'jpg' is not known; it is one of png, svg, pdf, csv"),
        ({"force_filter": "cfc"}, "filter = 'cfc' is not known; give cfc:CLASS"),
        ({"force_filter": "butterworth:-3"}, "is not known; give"),
        ({"force_filter": "cfc:6000"}, "needs 60000 rows of the history per second"),
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


@pytest.mark.slow
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


def texts(file) -> str:
    """The texts of a picture, which SVG keeps."""
    return " ".join(re.findall(r"<text[^>]*>([^<]*)</text>", file.read_text()))


@pytest.mark.slow
def test_what_does_not_change_is_named_instead_of_drawn(tmp_path, result):
    """A fixed probe, and one that flies at a constant velocity, take no panels but for its displacement."""
    time = result.history["time"]
    still, flight = np.zeros((len(time), 1, 3)), np.tile([0.0, 2.5, 0.0], (len(time), 1, 1))
    result.history |= {
        "probe/hinge/position": still + 7.0,
        "probe/hinge/velocity": still + 1e-15,
        "probe/free/position": flight * time[:, None, None],
        "probe/free/velocity": flight,
    }

    def drawn(name):
        written = {path.name: path for path in plot(result, tmp_path, formats=["svg", "csv"])}
        return written[f"{name}.csv"].read_text().partition("\n")[0], texts(written[f"{name}.svg"])

    columns, text = drawn("probes")
    assert list(dict.fromkeys(re.findall(r"probe/(\w+/\w+)\.", columns))) == [
        *("tip/displacement", "tip/velocity", "free/displacement"),
    ]
    assert "displacement of hinge (zero), velocity of hinge (zero), velocity of free (y = 2.5 m/s)" in text
    columns, text = drawn("momentum")
    assert "angular" not in columns and "angular momentum (zero)" in text
    # where nothing changes, everything is drawn
    result.history = {name: values if name == "time" else 0 * values for name, values in result.history.items()}
    assert "hinge" in drawn("probes")[0]


def test_rows_that_are_not_finite_leave_the_others(tmp_path, result):
    """A run that diverged."""
    for values in result.history.values():
        if values.dtype == float and values is not result.history["time"]:
            values[-3:] = np.nan
    names = [path.stem for path in plot(result, tmp_path, formats=["csv"])]
    assert names == ["energies", "momentum", "probes", "walls", "force_displacement", "solver"]
