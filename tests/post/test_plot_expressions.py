"""Curves that are computed from columns: values, units, filters, labels, bars of probes; by Python and by the words."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pictures import table_columns
from helpers.synthetic import SyntheticResult, ring
from matplotlib import rc_context
from matplotlib.text import Text
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.output.table import select
from pfem_petsc.post.chart import STYLE
from pfem_petsc.post.curves import make_filter, window_mean
from pfem_petsc.post.page import ColourScale, Heading, Page
from pfem_petsc.post.plot import draw_curves, draw_spectra, plot


@pytest.fixture
def result(tmp_path):
    return SyntheticResult(tmp_path / "result.vtkhdf", *ring())


@pytest.fixture(scope="module")
def rod(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rod")
    case = Case.load("rod_impact", ["time.end=1.5", "output.fields_every=0"])
    case.output.bar_probe = [{"name": "front", "indices": [19]}, {"name": "all three", "indices": [1, 8, 12]}]
    assert Simulation(case, MPI.COMM_SELF, output=folder, quiet=True).run() == 0
    return open_result(folder)


def drawn(folder, result, *curves, **options):
    """Columns of the table of curves, by their headings."""
    (file,) = plot(result, folder, curves=curves, formats="csv", **options)
    return dict(zip(*table_columns(file), strict=True))


def test_columns_of_expressions_have_their_units(tmp_path, result):
    force, energy = result.history["wall/wall/force"][:, 0], result.history["kinetic_energy"]
    found = drawn(tmp_path, result, "-wall/wall/force.x/1.2e-3", "-wall/wall/force.x/2[m2]", "kinetic_energy - 1")
    assert list(found) == [
        "time [s]",
        "-wall/wall/force.x/1.2e-3",
        "-wall/wall/force.x/2[m2] [Pa]",
        "kinetic_energy - 1 [J]",
    ]
    for values, expected in zip(list(found.values())[1:], (-force / 1.2e-3, -force / 2.0, energy - 1.0), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-12)


def test_the_axis_of_an_expression_has_its_unit_and_no_other(result):
    names = ["wall/wall/force.x", "-wall/wall/force.x/1.2e-3", "-wall/wall/force.x/1e-9[m2]"]
    with rc_context(STYLE):
        panels = draw_curves([result], [(name, None) for name in names]).axes
    shown = [axes.get_ylabel() for axes in panels]
    assert shown[0].startswith("force.x [") and shown[1] == "value of unknown unit"
    assert shown[2].startswith("stress [") and shown[2].endswith("Pa]")
    assert [axes.get_title(loc="left") for axes in panels] == names
    with rc_context(STYLE):
        (axes,) = draw_curves([result], [("kinetic_energy", None)]).axes
    assert axes.get_ylabel().startswith("kinetic energy [") and axes.get_title(loc="left") == ""


def test_curves_are_filtered_if_a_filter_is_named(tmp_path, result):
    """As computed without; with one also in expressions; energies, and what is computed from them alone, never."""
    time, force = result.history["time"], result.history["wall/wall/force"][:, 0]
    names = ["wall/wall/force.x", "3[1] - wall/wall/force.x / 2[N]", "2*kinetic_energy"]
    plain = list(drawn(tmp_path, result, *names).values())[1:]
    smooth = list(drawn(tmp_path, result, *names, force_filter="mean:0.005").values())[1:]
    np.testing.assert_array_equal(plain[0], force)
    np.testing.assert_array_equal(smooth[2], 2.0 * result.history["kinetic_energy"])
    np.testing.assert_allclose(smooth[0], window_mean(time, force, 0.005, True), atol=1e-12 * np.abs(force).max())
    # a constant is there before the run, and a force is not
    np.testing.assert_allclose(smooth[1], window_mean(time, 3.0 - force / 2.0, 0.005, False), rtol=1e-12)
    (file,) = plot(result, tmp_path, spectrum=["wall/wall/force.x"], formats="csv", window="rectangular")
    assert "filter" not in " ".join(table_columns(file)[0])


def test_an_expression_has_the_closed_form_of_its_columns(tmp_path, rod):
    """A wave compresses the end of the rod: rho c A v on 1.2e-3 m2, in tables also with the filter."""
    found = drawn(tmp_path, rod, "-wall/wall/force.x/1.2e-3[m2]", "bar/front/axial_force")
    assert list(found)[1:] == [
        "-wall/wall/force.x/1.2e-3[m2] [Pa]",
        "-wall/wall/force.x/1.2e-3[m2] closed form [Pa]",
        "bar/front/axial_force [N]",
    ]
    exact = found["-wall/wall/force.x/1.2e-3[m2] closed form [Pa]"]
    (material,), (section,) = rod.case.material.values(), rod.case.section.values()
    speed = np.linalg.norm(rod.case.initial[0].velocity)
    peak = np.sqrt(material.young_modulus * material.density) * section.area * speed / 1.2e-3
    assert exact.max() == pytest.approx(peak) and exact.min() == 0.0
    # behind the front of the wave, the bar at the wall has the same force
    assert found["bar/front/axial_force [N]"][-1] == pytest.approx(-peak * 1.2e-3, rel=0.02)


def test_bars_of_probes_have_a_picture(tmp_path, rod):
    written = plot(rod, tmp_path, formats=["csv", "png"])
    assert tmp_path / "bars.png" in written
    head, columns = table_columns(tmp_path / "bars.csv")
    assert head[1:] == [
        f"bar/{name} [{unit}]"
        for name, unit in [
            (f"{probe}/{kind}", unit)
            for probe in ("all three", "front")
            for kind, unit in (("axial_force", "N"), ("stress", "Pa"))
        ]
    ]
    np.testing.assert_allclose(columns[1], rod.history["bar/all three/axial_force"].mean(axis=1), rtol=1e-12)
    head, columns = table_columns(tmp_path / "history.csv")
    of_bar = dict(zip(head, columns, strict=True))["bar/all three/strain[2]"]
    np.testing.assert_array_equal(of_bar, rod.history["bar/all three/strain"][:, 2])


def test_bars_of_a_probe_by_number_mean_and_extremes(rod):
    forces = rod.history["bar/all three/axial_force"]
    for part, expected in (("[1]", forces[:, 1]), (".min", forces.min(axis=1)), (".max", forces.max(axis=1))):
        np.testing.assert_array_equal(select(rod.history, f"bar/all three/axial_force{part}").values, expected)
    table = rod.table(["-bar/all three/axial_force.min / 2", "bar/front"])
    assert list(table) == [
        *("step", "time", "(-bar/all three/axial_force.min / 2)"),
        *(f"bar/front/{name}[0]" for name in ("axial_force", "strain", "stress")),
    ]
    np.testing.assert_allclose(table["(-bar/all three/axial_force.min / 2)"], -forces.min(axis=1) / 2.0, rtol=1e-15)


def test_labels_name_the_results(tmp_path, result):
    other = SyntheticResult(tmp_path / "other" / "result.vtkhdf", *ring())
    long = "a label that says at length in how many steps, and with which law, this was computed"
    chart = draw_curves([result, other], [("kinetic_energy", None)], labels=[long, "short"])
    texts = [text.get_text() for text in chart.axes[0].get_legend().get_texts()]
    assert [" ".join(text.split()) for text in texts[:2]] == [long, "short"]
    assert max(len(line) for line in texts[0].split("\n")) <= 40
    with pytest.raises(InputError, match="2 results need as many different labels"):
        plot([result, other], tmp_path, labels=["one"])
    with pytest.raises(InputError, match="2 results need as many different labels"):
        plot([result, other], tmp_path, labels=["one", "one"])


def test_labels_of_a_single_result_name_its_curves(tmp_path, result):
    panels = [("-wall/wall/force.x/2[m2]", None), ("wall/wall/force", make_filter("mean:0.005"))]
    with rc_context(STYLE):
        chart = draw_curves([result], panels, labels=["mean stress", "wall"])
        (axes,) = draw_spectra([result], ["momentum.x"], labels=["all nodes"]).axes
    assert [axes.get_ylabel().partition(" [")[0] for axes in chart.axes] == ["mean stress", "wall"]
    assert chart.axes[0].get_title(loc="left") == ""
    assert chart.axes[1].get_title(loc="left").startswith("mean of the 5.00 ms before")
    assert axes.get_ylabel().startswith("amplitude of\nall nodes")
    with pytest.raises(InputError, match=r"one result needs a label for each curve \(2 here\), not \['one'\]"):
        draw_curves([result], panels, labels=["one"])
    with pytest.raises(InputError, match="labels name several results, or the curves of one: give curves"):
        plot(result, tmp_path, labels=["one"])


def test_a_result_has_one_colour_in_all_panels(tmp_path, result):
    """Beside components, which have dashes of their own; without any, dashes tell results apart as well."""
    other = SyntheticResult(tmp_path / "other" / "result.vtkhdf", *ring())
    for each in (result, other):
        each.history["wall/wall/force"][:, 2] = 5.0 * each.history["time"]
    panels = [("kinetic_energy", None), ("wall/wall/force", None)]
    energy, force = draw_curves([result, other], panels, closed_forms=False, labels=["one", "two"]).axes
    colours = {line.get_label(): line.get_color() for line in energy.get_lines()}
    lines = force.get_lines()
    assert len(lines) == 4 and len(set(colours.values())) == 2
    assert all(line.get_color() == colours[line.get_label().partition(" ")[0]] for line in lines)
    assert {(line.get_label()[-1], line.is_dashed()) for line in lines} == {("x", False), ("z", True)}
    (axes,) = draw_curves([result, other], panels[:1], closed_forms=False).axes
    assert [line.is_dashed() for line in axes.get_lines()] == [False, True]
    axes = draw_spectra([result, other], ["momentum.x", "wall/wall/force"], labels=["one", "two"]).axes
    assert [line.get_color() for line in axes[1].get_lines()] == [c for c in colours.values() for _ in range(2)]


def test_no_text_of_many_results_overlaps_another(tmp_path, result):
    others = [SyntheticResult(tmp_path / str(k) / "result.vtkhdf", *ring()) for k in range(11)]
    labels = [f"result {k} of a study of many parameters, of which this is number {k}" for k in range(12)]
    with rc_context(STYLE):
        chart = draw_curves([result, *others], [("kinetic_energy", None), ("momentum.x", None)], labels=labels)
        chart.figure.draw_without_rendering()
    for axes in chart.axes:
        boxes = [text.get_window_extent() for text in axes.get_legend().get_texts()]
        assert len(boxes) == 12
        assert all(one.y0 >= other.y1 for one, other in zip(boxes, boxes[1:], strict=False))
    legends = [axes.get_legend().get_window_extent() for axes in chart.axes]
    assert legends[0].y0 > legends[1].y1 and legends[0].x1 <= chart.figure.bbox.x1
    styles = {(line.get_color(), str(line.get_linestyle()), line.get_marker()) for line in chart.axes[0].get_lines()}
    assert len(styles) == 12


def test_an_expression_that_begins_with_a_minus_is_no_option(tmp_path, rod, capsys):
    words = ["plot", str(rod.path.parent), "-o", str(tmp_path), "--format", "csv"]
    assert main([*words, "--curves", "-wall/wall/force.x/1.2e-3", "-kinetic_energy", "-(time - 1)"]) == 0
    head, columns = table_columns(tmp_path / "curves.csv")
    assert "-wall/wall/force.x/1.2e-3" in head and "-kinetic_energy [J]" in head and "-(time - 1) [s]" in head
    np.testing.assert_allclose(columns[head.index("-(time - 1) [s]")], 1.0 - rod.history["time"], rtol=1e-12)
    assert main([*words, "--curves", "time", "--against", "-wall/wall/force.x"]) == 0
    assert table_columns(tmp_path / "curves_2.csv")[0] == ["-wall/wall/force.x [N]", "time [s]"]
    assert main([*words, "--curves", "time", "-x"]) == 2
    assert "unrecognized arguments: -x" in capsys.readouterr().err


def test_what_is_zero_throughout_divides_nothing(tmp_path, rod):
    with pytest.raises(InputError, match="momentum.x / broken_bars: is a number in no row, as it divides by zero"):
        plot(rod, tmp_path, curves=["momentum.x / broken_bars"])


def test_captions_of_drawings_side_by_side_do_not_overlap():
    """Long names are cut, the times behind them are not."""
    scale = ColourScale((0.0, 1.0), unit="Pa")
    captions = [f"{name}, t = {k}.00 s" for name in ("short", "a name that is longer than " * 4) for k in range(3)]
    page = Page((1280, 720), Heading("title", "stress", scale), captions, 3)
    texts = [tile.get_title(loc="left") for tile in page.tiles]
    assert texts[:3] == captions[:3]
    assert all(text.startswith("a name") and text.endswith(f"…, t = {k}.00 s") for k, text in enumerate(texts[3:]))
    for tile in page.tiles:
        found = [child for child in tile.get_children() if isinstance(child, Text) and child.get_text()]
        assert found[0].get_window_extent().x1 <= tile.get_window_extent().x1
