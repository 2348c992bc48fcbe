"""Curves of cases with static and dynamic stages, whose results count load factors as time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pictures import table_columns

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.post.curves import amplitude_spectrum, cfc, window_mean
from pfem_petsc.post.plot import plot

STEP, END = 1e-3, 0.2
LEFT = {"name": "left", "type": "plane", "point": [-0.02, 0.0, 0.0], "normal": [1.0, 0.0, 0.0], "mass": 5.0}
PLATE = {"name": "plate", "type": "plane", "point": [1.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
PRESS = {"name": "press", "static": {"step": 0.25}, "wall": [{**PLATE, "motion": [[0, 0, 0, 0], [1, -0.01, 0, 0]]}]}
FLIGHT = {
    "name": "flight",
    "time": {"integrator": "central_differences", "step": STEP, "end": END},
    "support": [{"node_set": "every", "fix": "yz"}],
    "initial": {"velocity": [-2.0, 0.0, 0.0]},
    "wall": [LEFT],
}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A rod that is pressed by a plate, then let go towards a wall with mass."""
    rod = Case.load("rod_impact").to_dict()
    case = {key: rod[key] for key in ("mesh", "material", "section")}
    case["node_set"] = {"every": {"all": True}, "tip": {"nearest": [1.0, 0.0, 0.0]}, "base": {"nearest": [0.0, 0, 0]}}
    case["support"] = [{"node_set": "every", "fix": "yz"}, {"node_set": "base", "fix": "x"}]
    case["output"] = {"fields_every": 1, "probe": [{"name": "tip", "node_set": "tip"}]}
    case["stage"] = [PRESS, FLIGHT, {"name": "again", "static": {"step": 0.5}, "support": case["support"], "wall": []}]
    case["material"]["default"]["young_modulus"], case["material"]["default"]["density"] = 1e6, 1000.0
    folder = tmp_path_factory.mktemp("staged")
    assert Simulation(Case.from_dict(case, name="staged"), output=folder, quiet=True).run() == 0
    return open_result(folder)


@pytest.mark.slow
def test_rows_of_motion_are_told_from_those_of_static_stages(result):
    (rows,) = result.stretches
    assert set(result.history["stage"][rows]) == {1}
    assert rows.stop - rows.start == np.count_nonzero(result.history["stage"] == 1) == round(END / STEP)


def test_filters_act_on_rows_of_motion_only(tmp_path, result):
    """The default is the mean of 2 % of the time of motion, which is longer than the interval of its rows."""
    (rows,), history = result.stretches, result.history
    time = history["time"][rows]
    filters = {
        "cfc:6": lambda values: cfc(time, values, 6.0, True),
        None: lambda values: window_mean(time, values, 0.02 * np.ptp(time), True),
    }
    for text, smooth in filters.items():
        plot(result, tmp_path, force_filter=text, formats=["csv"])
        head, columns = table_columns(tmp_path / "walls.csv")
        found = [values for heading, values in zip(head, columns, strict=True) if "left/force" in heading]
        computed, filtered = found
        assert np.abs(computed[rows]).any() and filtered[rows] == pytest.approx(smooth(computed[rows]), abs=1e-9)
        plate = [values for heading, values in zip(head, columns, strict=True) if "plate/force" in heading]
        assert plate[0][: rows.start].any() and all(np.array_equal(plate[0], other) for other in plate)


def test_spectra_are_of_rows_of_motion(tmp_path, result):
    plot(result, tmp_path, spectrum=["probe/tip/position.x"], formats=["csv"])
    _, (frequency, amplitude) = table_columns(tmp_path / "spectra.csv")
    (rows,), history = result.stretches, result.history
    expected = amplitude_spectrum(history["time"][rows], history["probe/tip/position"][rows, 0, 0])
    assert frequency == pytest.approx(expected[0]) and amplitude == pytest.approx(expected[1])


@pytest.mark.slow
def test_the_axis_says_that_load_factors_are_on_it(tmp_path, result):
    plot(result, tmp_path, formats=["csv", "svg"])
    assert "time [s], in static stages load factor" in (tmp_path / "walls.svg").read_text()
    assert table_columns(tmp_path / "walls.csv")[0][0] == "time [s], in static stages load factor"
    assert result.axis.span(0.0, 2.0) == "0 to 2 (time [s], in static stages load factor)"
    assert [result.place(time) for time in (0.125, 1.0, 1.05, 1.7, 2.2)] == [
        "press, load factor 0.125",
        "press, load factor 1",
        "t = 1.050 s",
        "again, load factor 0.5",
        "again, load factor 1",
    ]


def test_walls_of_later_stages_stand_where_they_begin(result):
    position = result.history["wall/left/position"]
    (rows,) = result.stretches
    np.testing.assert_array_equal(position[: rows.start], [LEFT["point"]] * rows.start)
    assert position[rows.start, 0] == pytest.approx(LEFT["point"][0], abs=2.0 * STEP)
    np.testing.assert_array_equal(position[rows.stop :], position[[rows.stop - 1] * 2])


@pytest.mark.slow
def test_static_stages_alone_have_no_filter(tmp_path, result):
    case = result.case.to_dict()
    case["stage"] = [stage for stage in case["stage"] if "static" in stage][:1]
    assert Simulation(Case.from_dict(case, name="static"), output=tmp_path / "out", quiet=True).run() == 0
    with pytest.raises(InputError, match="needs a run over time"):
        plot(tmp_path / "out", tmp_path, force_filter="cfc:6")
    assert "walls.png" in [path.name for path in plot(tmp_path / "out", tmp_path)]
