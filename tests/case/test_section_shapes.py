"""Shapes of cross-sections: areas and moments against tables and sums over cells, sizes from areas, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pfem_petsc import Case
from pfem_petsc.case.section_shapes import cross_section
from pfem_petsc.errors import InputError


def test_circles():
    tube = cross_section("tube", {"diameter": 0.1, "thickness": 0.005})
    assert tube.area == pytest.approx(math.pi * (0.05**2 - 0.045**2), rel=1e-14)
    assert tube.second_moment == pytest.approx(math.pi / 4.0 * (0.05**4 - 0.045**4), rel=1e-14)
    assert tube.width == 0.1
    areas = np.array([1e-3, float(tube.area)])
    by_diameter = cross_section("tube", {"diameter": 0.1}, areas)
    by_thickness = cross_section("tube", {"thickness": 0.005}, areas)
    for found in (by_diameter, by_thickness):
        np.testing.assert_allclose([found.area[1], found.radius[1]], [tube.area, 0.05], rtol=1e-13)
        assert found.second_moment[1] == pytest.approx(tube.second_moment, rel=1e-12)
    solid = cross_section("round", {"diameter": 0.1})
    assert cross_section("round", {}, solid.area).width == pytest.approx(0.1, rel=1e-14)


def test_box_and_i_section_by_rectangles():
    b, h, t, w = 0.1, 0.2, 0.0085, 0.0056
    box = cross_section("box", {"width": b, "height": h, "thickness": t})
    assert box.area == pytest.approx(b * h - (b - 2 * t) * (h - 2 * t), rel=1e-13)
    assert box.second_moment == pytest.approx((h * b**3 - (h - 2 * t) * (b - 2 * t) ** 3) / 12.0, rel=1e-13)
    assert box.plastic_modulus == pytest.approx((h * b**2 - (h - 2 * t) * (b - 2 * t) ** 2) / 4.0, rel=1e-13)
    beam = cross_section("I", {"width": b, "height": h, "thickness": t, "web_thickness": w})
    assert beam.area == pytest.approx(2 * b * t + (h - 2 * t) * w, rel=1e-13)
    assert beam.second_moment == pytest.approx((2 * t * b**3 + (h - 2 * t) * w**3) / 12.0, rel=1e-13)
    assert beam.plastic_modulus == pytest.approx((2 * t * b**2 + (h - 2 * t) * w**2) / 4.0, rel=1e-13)


def test_thickness_from_an_area():
    """The smallest thickness that is tried has no axis of equal halves to rounding."""
    sizes = {"width": 0.03957047351167371, "height": 0.03883870351542023}
    found = cross_section("channel", sizes, 1e-3)
    t = max(np.roots([-2.0, 2.0 * 0.03957047351167371 + 0.03883870351542023, -1e-3]).min(), 0.0)
    assert found.area == pytest.approx(1e-3, rel=1e-12)
    assert found.second_moment == pytest.approx(cross_section("channel", {**sizes, "thickness": t}).second_moment)


@pytest.mark.parametrize(
    ("shape", "sizes", "inside", "least"),
    [
        ("angle", {"width": 0.06, "thickness": 0.006}, lambda x, y: (x < 0.006) | (y < 0.006), 9.516e-8),
        ("angle", {"width": 0.06, "height": 0.1, "thickness": 0.01}, lambda x, y: (x < 0.01) | (y < 0.01), None),
        (
            "channel",
            {"width": 0.08, "height": 0.16, "thickness": 0.012, "web_thickness": 0.008},
            lambda x, y: (x < 0.008) | (y < 0.012) | (y > 0.148),
            None,
        ),
    ],
)
def test_weak_axis_by_cells(shape, sizes, inside, least):
    """Sums over square cells, with principal axes of their own; the equal leg also by 45 degrees (EN 10056 less the
    roots of its legs: 9.43 cm4)."""
    found = cross_section(shape, sizes)
    width, height, cell = sizes["width"], sizes.get("height", sizes["width"]), 1e-4 / 2
    x, y = np.meshgrid(np.arange(0.5 * cell, width, cell), np.arange(0.5 * cell, height, cell))
    x, y = x[inside(x, y)], y[inside(x, y)]
    assert found.area == pytest.approx(len(x) * cell**2, rel=1e-9)
    tensor = np.cov(np.vstack([x, y]), bias=True) * found.area
    moments, axes = np.linalg.eigh(tensor)
    assert found.second_moment == pytest.approx(moments[0], rel=2e-4)
    distance = axes[:, 0] @ np.vstack([x, y])
    assert found.plastic_modulus == pytest.approx(np.abs(distance - np.median(distance)).mean() * found.area, rel=1e-3)
    if least is not None:
        assert found.second_moment == pytest.approx(least, rel=1e-4)
    same = cross_section(shape, {key: value for key, value in sizes.items() if key != "thickness"}, found.area)
    assert same.second_moment == pytest.approx(found.second_moment, rel=1e-9)


def case(**section):
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
            "material": {"m": {"young_modulus": 2e9, "density": 1e3}},
            "section": {"a": {"material": "m", **section}},
            "time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4},
        }
    )


@pytest.mark.parametrize(
    ("section", "text"),
    [
        ({}, "expected area, area_field, or a shape"),
        ({"shape": "round"}, "needs one of area, diameter, got none"),
        ({"shape": "tube", "diameter": 0.1}, "needs two of area, diameter, thickness, got diameter"),
        ({"shape": "tube", "diameter": 0.1, "thickness": 0.051}, "thickness = 0.051 m is more than half of diameter"),
        ({"shape": "tube", "diameter": 0.1, "area": 1e-2}, "diameter = 0.1 m is too little"),
        ({"shape": "round", "width": 0.1}, 'width is no size of shape = "round", which has diameter'),
        ({"shape": "angle", "width": 0.06}, "needs width and thickness, or width and area"),
        ({"shape": "angle", "width": 0.06, "thickness": 0.07}, "thickness = 0.07 m is too much: at most 0.06 m"),
        ({"shape": "box", "width": 0.06, "thickness": 0.01, "web_thickness": 0.01}, "web_thickness is no size of"),
        ({"shape": "I", "width": 0.1, "thickness": 0.01, "web_thickness": 0.2}, "web_thickness = 0.2 m is too much"),
        ({"shape": "box", "width": 0.06, "area": 1.0}, "area = 1.0 m2 cannot be that of shape"),
        ({"shape": "box", "width": 0.06, "area_field": "a"}, "area_field goes with circles"),
        ({"area": 1e-4, "height": 0.1}, "height needs a shape"),
        ({"area": 1e-4, "shape": "round", "second_moment": 1e-8}, "at most one of the keys shape, second_moment"),
        ({"shape": "round", "diameter": 1e200}, "out of range"),
    ],
)
def test_refused(section, text):
    with pytest.raises(InputError, match=text):
        case(**section)


def test_sizes_give_the_area_and_can_be_changed():
    made = case(shape="tube", diameter=0.1, thickness=0.005)
    assert made.section["a"].uniform_area == pytest.approx(math.pi * (0.05**2 - 0.045**2))
    made.section["a"].thickness = 0.01
    assert made.section["a"].uniform_area == pytest.approx(math.pi * (0.05**2 - 0.04**2))
    assert Case.from_toml(made.to_toml()) == made


def test_profiles_of_a_catalogue(tmp_path):
    (tmp_path / "profiles.csv").write_text(
        "# hot rolled\nprofile;area;second_moment;shape;width;thickness\n"
        "IPE200;28.5e-4;142e-8;;;\nL60x6;;;angle;0.06;0.006\n"
    )

    def read(profile, **keys):
        data = case(area=1.0).to_dict() | {
            "section": {"a": {"material": "m", "catalogue": "profiles.csv", "profile": profile, **keys}}
        }
        return Case.from_dict(data, folder=tmp_path)

    beam = read("IPE200")
    assert (beam.section["a"].area, beam.section["a"].second_moment) == (28.5e-4, 142e-8)
    assert "catalogue" not in beam.to_toml()
    assert read("L60x6").section["a"].uniform_area == pytest.approx(6.84e-4)
    for profile, keys, text in (
        ("IPE220", {}, "no profile is called 'IPE220', did you mean 'IPE200'"),
        ("IPE200", {"area": 1.0}, "the profile 'IPE200' has this value too"),
        ("", {}, "need each other"),
    ):
        with pytest.raises(InputError, match=text):
            read(profile, **keys)
    (tmp_path / "profiles.csv").write_text("profile,aera\nIPE200,1\n")
    with pytest.raises(InputError, match="column 'aera' is no key of a section, did you mean 'area'"):
        read("IPE200")
