"""What pictures show beyond coloured bars: radii, marks, trajectories, refused options."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pictures import box, camera_of, draw, drawing, near, picture_of
from helpers.synthetic import SyntheticResult, lattice, ring

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.post.motion import chosen_frames, drawn_radii
from pfem_petsc.post.options import frames_of
from pfem_petsc.post.page import GHOST, MARKS, TRAILS
from pfem_petsc.post.scene import Layer, Style


@pytest.fixture
def flying(tmp_path):
    return SyntheticResult(tmp_path / "x" / "result.vtkhdf", *ring(), walls=())


@pytest.fixture(scope="module")
def bars_of_sections(tmp_path_factory):
    """Three bars: solid, a tube, and one with an area of a field."""
    points = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    data = {
        "mesh": {
            "generator": "arrays",
            "points": points,
            "bars": [[0, 1], [0, 2], [0, 3]],
            "bar_groups": {"pipe": [1], "graded": [2]},
            "bar_fields": {"area": [1.0, 1.0, 4e-4]},
        },
        "node_set": {"all": {"all": True}},
        "material": {"m": {"young_modulus": 1e9, "density": 1e3}},
        "section": {
            "rod": {"area": 1e-4, "material": "m"},
            "pipe": {"bars": "pipe", "area": 2e-4, "shape": "tube", "thickness": 1e-3, "material": "m"},
            "graded": {"bars": "graded", "area_field": "area", "material": "m"},
        },
        "support": [{"node_set": "all", "fix": "xyz"}],
        "time": {"integrator": "central_differences", "step": 1e-6, "end": 1e-6},
    }
    folder = tmp_path_factory.mktemp("radii") / "result"
    with Simulation(Case.from_dict(data), output=folder, quiet=True) as simulation:
        simulation.run()
    return folder


def test_radii_are_those_of_sections_and_fields(bars_of_sections):
    outer = 2e-4 / (2 * math.pi * 1e-3) + 0.5e-3
    expected = [math.sqrt(1e-4 / math.pi), outer, math.sqrt(4e-4 / math.pi)]
    assert drawn_radii(open_result(bars_of_sections)) == pytest.approx(expected, rel=1e-12)


def of_one_section(result, area):
    """The result with one section of an area."""
    section = Case.load("rod_impact").section["default"].model_copy(update={"area": area})
    result.case.section, result.bar_data = {"one": section}, ("section", "area")
    given, of_bars = result.field, {"section": np.full(result.n_bars, "one"), "area": np.full(result.n_bars, area)}
    result.field = lambda name, i: of_bars[name] if name in of_bars else given(name, i)


def test_stout_bars_are_drawn_thinner_with_a_remark(flying):
    """Balls of such a radius at the nodes would hide all that happens."""
    of_one_section(flying, 100.0 * math.pi)
    said = []
    start = flying.positions(0)
    length = np.linalg.norm(start[flying.bars[:, 1]] - start[flying.bars[:, 0]], axis=1)
    assert drawn_radii(flying, said.append) == pytest.approx(0.2 * length)
    assert f"{flying.n_bars} of {flying.n_bars} bars" in said[0] and "(10 m at most)" in said[0]


CUBE = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
VIEWS = pytest.mark.parametrize("view", ["xy", (0.0, 0.0, 1.0)], ids=["parallel", "perspective"])


@pytest.mark.parametrize("count", [1, 2001, 20_001], ids=["few", "some", "many"])
@pytest.mark.parametrize("view", ["xy", (0.0, -1.0, 0.0)], ids=["parallel", "perspective"])
def test_tubes_have_their_radius(view, count):
    """A bar of radius r across the view is 2 r wide and l + 2 r long, with round ends; as one of many, without."""
    points, radius, size = np.array([[-0.5, 0, 0], [0.5, 0, 0.0]]), 0.1, (400, 300)
    camera, style = camera_of(0.5 * CUBE, view, 4 / 3), Style(np.full(count, radius), nodes=False)
    picture = picture_of(points, np.tile([[0, 1]], (count, 1)), np.full((count, 3), 90), camera, size, style)
    rows, columns = (picture.min(axis=2) < 250).nonzero()
    scale, ends = size[1] / (2 * camera.half_height), 1.0 if count <= 20_000 else 0.0
    assert np.ptp(rows) + 1 == pytest.approx(2 * radius * scale, abs=1.6 if count == 1 else 4.0)
    assert np.ptp(columns) + 1 == pytest.approx((1.0 + 2 * ends * radius) * scale, abs=2.0)
    area = (2 * radius + ends * math.pi * radius**2) * scale**2
    assert len(rows) == pytest.approx(area, rel=0.04 if count == 1 else 0.12)


@VIEWS
def test_what_is_nearer_hides(view):
    """Two crossed bars in both orders, a red one in front."""
    points = np.array([[-1, 0, 0.1], [1, 0, 0.1], [0, -1, -0.1], [0, 1, -0.1]], dtype=float)
    red, blue = (200, 0, 0), (0, 0, 200)
    camera, style = camera_of(CUBE, view), Style(np.full(2, 0.15), nodes=False)
    for bars, colours in (([[0, 1], [2, 3]], (red, blue)), ([[2, 3], [0, 1]], (blue, red))):
        middle = picture_of(points, bars, colours, camera, (160, 160), style)[80, 80]
        assert middle[0] > middle[2] + 60


@pytest.mark.slow
def test_lines_and_tubes_are_chosen_by_the_number_of_bars(tmp_path):
    """Up to 20,000 bars, thick ones hide most of the page."""
    for cells, thick in ((3, True), (16, False)):
        result = SyntheticResult(tmp_path / f"{cells}.vtkhdf", *lattice(cells), walls=())
        of_one_section(result, math.pi * (0.1 / cells) ** 2)
        plain, wide = (
            (drawing(draw(tmp_path, result, frames=[0], radius_scale=factor)[0])[..., :3].min(axis=2) < 250).mean()
            for factor in (0.01, 1.0)
        )
        assert (wide > 1.1 * plain) == thick


def test_small_models_are_not_hair_thin(tmp_path, flying):
    """The bars of a slender ring cover some hundredths of its frame with no option at all."""
    picture = drawing(draw(tmp_path, flying, frames=[0], size=(640, 360))[0])
    assert (picture[..., :3].min(axis=2) < 200).mean() > 0.04
    top, bottom, _, _ = box(picture)
    assert bottom - top > 0.85 * picture.shape[0]


def test_ghost_stays_where_the_structure_was(tmp_path, flying):
    options = {"frames": [6], "size": (960, 640)}
    plain, ghost = (drawing(draw(tmp_path, flying, ghost=on, **options)[0]) for on in (False, True))
    pale = near(ghost, GHOST, 3)
    assert len(pale[0]) > 5 * len(near(plain, GHOST, 3)[0]) + 300
    # the ring has flown to the right
    assert pale[1].min() < box(plain)[2] - 10


@VIEWS
def test_what_is_added_has_its_depth(view):
    """A trajectory or ghost in front of a bar is seen, one behind it hidden; at the same place, the shift decides."""
    points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    camera, style = camera_of(CUBE, view), Style(bar_width=8.0, nodes=False)
    for height, sign, seen in ((0.8, 0.0, True), (-0.8, 0.0, False), (0.0, 1.0, True), (0.0, -1.0, False)):
        places = np.array([[0.0, -1.0, height], [0.0, 1.0, height]])

        def layers(scene, places=places, sign=sign):
            return [Layer(places, np.array([[0, 1]]), (0, 158, 115), 12.0, sign * scene.thickness(camera))]

        picture = picture_of(points, [[0, 1]], [[255, 0, 0]], camera, (200, 200), style, layers)
        assert (picture[100, 100, 1] > picture[100, 100, 0]) == seen, (height, sign)
        assert picture[40, 100, 1] > picture[40, 100, 0]


def test_a_field_of_rounding_errors_has_no_colours(tmp_path, flying):
    """Stresses of 1e-6 Pa of a ring of steel that flies without a force."""
    flying.case.material = {"steel": SimpleNamespace(young_modulus=2.1e11)}
    stress, told = flying.field, []
    flying.field = lambda name, i: 1e-6 * np.sin(np.arange(flying.n_bars)) if name == "stress" else stress(name, i)
    (file,) = draw(tmp_path, flying, frames=[0], note=told.append)
    assert told == ["stress is zero in all frames, to rounding"]
    picture = drawing(file)
    inked = picture[picture[..., :3].min(axis=2) < 150][:, :3]
    assert np.ptp(inked, axis=1).max() < 40  # grey


def test_yielded_and_broken_bars_are_marked(tmp_path, flying):
    flying.cell_fields = [*flying.cell_fields, "status"]
    gone = np.zeros(flying.n_bars, dtype=int)
    gone[:3] = 1
    fields = {"plastic_strain": np.where(np.arange(flying.n_bars) >= flying.n_bars - 5, 0.1, 0.0), "status": gone}
    plain = flying.field
    flying.field = lambda name, i: fields[name] if name in fields else plain(name, i)
    options = {"frames": [0], "nodes": False, "size": (480, 320)}
    without = drawing(draw(tmp_path, flying, **options)[0])
    marked = drawing(draw(tmp_path, flying, marks=["broken", "yielded"], **options)[0])
    for mark in MARKS.values():
        assert len(near(marked, mark.colour)[0]) > len(near(without, mark.colour)[0]) + 20, mark.text


def test_trajectories_grow(tmp_path, flying):
    files = draw(tmp_path, flying, frames=[2, 5], trails=["tip"], size=(960, 640))
    early, late = (near(drawing(file), TRAILS[0])[0] for file in files)
    assert 0 < len(early) < len(late)
    with pytest.raises(InputError, match="no probe 'tap'; its probes are tip, did you mean 'tip'"):
        draw(tmp_path, flying, trails=["tap"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"style": "ribbons"}, "auto, tubes, lines"),
        ({"radius_scale": -1.0}, "radius_scale"),
        ({"marks": ["slack"]}, "broken, yielded"),
        ({"marks": ["broken"]}, "no field 'status'"),
        ({"zoom": 0.0}, "zoom = 0"),
        ({"scale": math.nan}, "scale = nan"),
        ({"fps": math.inf}, "fps = inf"),
        ({"bar_width": 1e9}, "500 pixels at most"),
        ({"view": (0.0, 0.0, 0.0)}, "is not a direction"),
        ({"rate": 1e9}, "give 2 to 20000 frames"),
        ({"rate": 100.0, "frames": 3}, "give one of the two"),
        ({"span": (0.4, 0.3)}, "two increasing times"),
        ({"follow": "tap"}, "no probe 'tap'"),
    ],
)
def test_refused_looks(tmp_path, flying, options, message):
    with pytest.raises(InputError, match=message):
        draw(tmp_path, flying, **options)


@pytest.mark.parametrize(
    ("words", "chosen"), [("1", [11]), ("2", [0, 11]), ("7,", [7]), ("-1,", [11]), ("3,-2", [3, 10])]
)
def test_frames_by_number_and_by_index(words, chosen):
    """A single frame is the last one: at the first, a structure looks like its mesh."""
    assert chosen_frames(frames_of(words), np.arange(12.0), print) == chosen
    assert chosen_frames(1, np.arange(12.0), print, span=(2.0, 5.5)) == [5]
