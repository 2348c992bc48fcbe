"""Curves by name, their tables, spectra, and what they are averaged by."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from helpers.pictures import saturated, table_columns
from helpers.synthetic import SyntheticResult, ring
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.post import chart
from pfem_petsc.post.chart import DASHES, REFERENCE, distinct
from pfem_petsc.post.curves import make_filter, window_mean
from pfem_petsc.post.plot import draw_spectra, plot


@pytest.fixture
def result(tmp_path):
    return SyntheticResult(tmp_path / "result.vtkhdf", *ring())


def test_unknown_curve_is_refused_with_the_nearest(tmp_path, result):
    with pytest.raises(InputError, match=r"no column 'kinetic_enrgy', did you mean 'kinetic_energy'\?"):
        plot(result, tmp_path, curves=["kinetic_enrgy"])
    with pytest.raises(InputError, match="no curves named"):
        plot(result, tmp_path, curves=[])


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


def test_forces_over_displacements(tmp_path, result):
    (file,) = plot(result, tmp_path, curves=["wall/wall/force.x"], against="centre_of_mass.x", formats=["csv"])
    head, (place, force) = table_columns(file)
    assert head == ["centre_of_mass.x [m]", "wall/wall/force.x [N]"]
    assert np.array_equal(place, result.history["centre_of_mass"][:, 0])
    assert np.array_equal(force, result.history["wall/wall/force"][:, 0])
    with pytest.raises(
        InputError, match=r"against = 'centre_of_mass' is a vector: name a component, centre_of_mass\.x"
    ):
        plot(result, tmp_path, curves=["kinetic_energy"], against="centre_of_mass")


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


def test_energies_are_never_filtered(tmp_path, result):
    """In a comparison, forces are as computed and, below, filtered; named curves are filtered but for energies."""
    other = SyntheticResult(tmp_path / "fine" / "result.vtkhdf", *ring())
    history, mean = result.history, "mean of the 5.00 ms before (−3 dB at 88.6 Hz)"
    smooth = window_mean(history["time"], history["wall/wall/force"][:, 0], 0.005, True)
    assert np.abs(smooth - history["wall/wall/force"][:, 0]).max() > 0.1 * np.abs(smooth).max()
    (file,) = plot([result, other], tmp_path / "both", force_filter="mean:0.005", formats=["csv"])
    head, columns = table_columns(file)
    found = dict(zip(head, columns, strict=True))
    here = tmp_path.name
    assert found[f"wall/wall/force.x: {here} [N]"] == pytest.approx(history["wall/wall/force"][:, 0])
    assert found[f"wall/wall/force.x: {here}, {mean} [N]"] == pytest.approx(smooth)
    energies = [name for name in head if "_energy" in name or "_dissipation" in name]
    assert len(energies) >= 4
    for name in energies:
        assert np.array_equal(found[name], history[name.partition(":")[0]])
    # without a filter, the usual one
    (file,) = plot([result, other], tmp_path / "usual", formats=["csv"])
    assert [name for name in table_columns(file)[0] if name.startswith(f"wall/wall/force.x: {here}, mean of the")]
    curves = ["kinetic_energy", "wall/wall/force.x"]
    (file,) = plot(result, tmp_path, curves=curves, force_filter="mean:0.005", formats=["csv"])
    _, (_, energy, force) = table_columns(file)
    assert np.array_equal(energy, history["kinetic_energy"]) and force == pytest.approx(smooth)
    # over another column, which passes the same filter
    (file,) = plot(
        result, tmp_path, curves=curves[1:], against="centre_of_mass.x", force_filter="mean:0.005", formats="csv"
    )
    _, (place, force) = table_columns(file)
    moved = window_mean(history["time"], history["centre_of_mass"][:, 0], 0.005)
    assert place == pytest.approx(moved) and force == pytest.approx(smooth)


def test_many_lines_and_areas_differ():
    """From each other, and lines from closed forms; those of two results differ by their dashes as well."""
    styles = [distinct(k) for k in range(256)]
    assert len({(s["color"], str(s["linestyle"]), s.get("marker", "")) for s in styles}) == 256
    assert len({(s["color"], str(s["linestyle"])) for s in styles[:32]}) == 32
    assert not any(s["color"] == REFERENCE["color"] and s["linestyle"] == DASHES[1] for s in styles[:31])
    areas = [chart.area(k) for k in range(16)]
    assert len({(s.get("color", s.get("facecolor")), s.get("hatch")) for s in areas}) == 16
    assert distinct(1, 1)["linestyle"] != distinct(0, 0)["linestyle"]


def test_displacements_are_compared_and_not_positions(tmp_path):
    """A probe far from the origin that moves little; and no picture of the load factor over itself."""
    results = []
    for folder, area in (("thin", 1e-4), ("thick", 2e-4)):
        case = Case(
            mesh=Truss([[50.0, 0, 0], [51, 0, 0], [50.5, 0, 1]], [[0, 2], [1, 2], [0, 1]], node_groups={"top": [2]}),
            node_set={"top": {"group": "top"}, "feet": {"box": [[0, -1, -0.1], [60, 1, 0.1]]}, "all": {"all": True}},
            material={"m": {"young_modulus": 2e11, "density": 1.0}},
            section={"s": {"area": area, "material": "m"}},
            support=[{"node_set": "feet", "fix": "xyz"}, {"node_set": "all", "fix": "y"}],
            load=[{"node_set": "top", "force": [0.0, 0.0, -1e4]}],
            static={"step": 0.5},
            output={"probe": [{"name": "top", "node_set": "top"}, {"name": "feet", "node_set": "feet"}]},
        )
        with Simulation(case, MPI.COMM_SELF, output=tmp_path / folder, quiet=True) as simulation:
            simulation.run()
        results.append(tmp_path / folder)
    (file,) = plot(results, tmp_path, formats=["csv"])
    head, columns = table_columns(file)
    names = [name.partition(": ")[0] for name in head]
    assert names[0] == "load factor" and "probe/top/displacement.z" in names
    assert not {"probe/top/position.z", "load_factor", "probe/feet/displacement.z"} & set(names)
    thin, thick = (column for name, column in zip(names, columns, strict=True) if name == "probe/top/displacement.z")
    z = open_result(results[0]).history["probe/top/position"][:, 0, 2]
    assert thin == pytest.approx(z - z[0], abs=1e-15) and thick[-1] == pytest.approx(0.5 * thin[-1], rel=1e-2)


def test_spectra_have_the_amplitude(tmp_path, result):
    time = result.history["time"]
    result.history["probe/tip/velocity"] = np.zeros((len(time), 1, 3))
    frequency = 20 / (time[-1] * len(time) / (len(time) - 1))
    result.history["probe/tip/velocity"][:, 0, 1] = 3.0 * np.sin(2 * np.pi * frequency * time)
    (file,) = plot(result, tmp_path, spectrum=["probe/tip/velocity"], formats=["csv"])
    assert file.name == "spectra.csv"
    head, (places, amplitude) = table_columns(file)
    assert head == ["frequency [Hz]", "probe/tip/velocity.y [m/s]"]
    assert places[20] == pytest.approx(frequency) and amplitude.argmax() == 20 and amplitude[20] == pytest.approx(3.0)
    assert len(saturated(plot(result, tmp_path, spectrum=["probe/tip/velocity"])[0])) > 300


def test_frequencies_have_prefixes(tmp_path, result):
    """Of filters, and of the axis of a spectrum by the highest frequency that is shown."""
    assert make_filter("mean:5e-6").name == "mean of the 5.00 µs before (−3 dB at 88.6 kHz)"
    assert "−3 dB at 12.5 kHz" in make_filter("butterworth:12500").name
    assert "−3 dB at 1.67 kHz" in make_filter("cfc:1000").name
    result.history["time"] = result.history["time"] / 1e4
    ends = [draw_spectra([result], ["momentum.x"], highest=highest).axes[0] for highest in (None, 4e2)]
    assert [axes.get_xlabel() for axes in ends] == ["frequency [MHz]", "frequency [Hz]"]
    assert ends[1].get_xlim() == (0.0, 400.0)
