"""Keys of sections that would have no effect in the case as given are refused, with what to do."""

from __future__ import annotations

import pytest

from pfem_petsc import Case
from pfem_petsc.errors import InputError

TUBE = {"area": 1e-4, "material": "m", "shape": "tube", "thickness": 1e-3}
WIND = {"wind": {"velocity": [1.0, 0.0, 0.0]}}
STRUT = {"material": {"m": {"law": "strut", "young_modulus": 2e9, "density": 1e3, "yield_stress": 1e7}}}


def case(section, overrides=(), **more):
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
        "material": {"m": {"young_modulus": 2e9, "density": 1e3}},
        "section": {"a": {"area": 1e-4, "material": "m", **section}},
        "time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4},
    }
    return Case.from_dict(data | more, overrides=overrides)


@pytest.mark.parametrize(
    ("section", "overrides", "more", "text"),
    [
        ({"diameter": 0.1}, (), {}, "section.a.diameter = 0.1: has an effect in wind alone: remove the key"),
        ({}, ["section.a.drag_coefficient=1"], {}, r"drag_coefficient = 1.0 \(given by --set\): has an effect in wind"),
        ({"effective_length": 0.5}, (), {}, "section.a.effective_length = 0.5: has no effect: bars .* not checked for"),
        (
            {"shape": "round", "effective_length": 0.5},
            (),
            {"material": {"m": {"law": "cable", "young_modulus": 2e9, "density": 1e3}}},
            "section.a.effective_length = 0.5: has no effect",
        ),
        (
            TUBE,
            ["section.a.thickness=2e-3"],
            {},
            r"thickness = 0.002 \(given by --set\): changes no result: .* change area",
        ),
        (TUBE | {"diameter": 0.1}, (), {}, 'shape = "tube" needs two of area, diameter, thickness, got diameter and'),
        ({"thickness": 1e-3}, (), {}, "thickness needs a shape: round, tube, angle, box, I, channel"),
    ],
)
def test_refused(section, overrides, more, text):
    with pytest.raises(InputError, match=text):
        case(section, overrides, **more)


def test_accepted():
    angle = {"area": None, "shape": "angle", "width": 0.1, "thickness": 1e-3}
    assert case(angle, ["section.a.thickness=2e-3"]).section["a"].uniform_area == pytest.approx(0.198 * 2e-3)
    case({"diameter": 0.1, "drag_coefficient": 1.0}, **WIND)
    case({"area": None, "shape": "tube", "diameter": 0.1, "thickness": 1e-3}, ["section.a.thickness=2e-3"])
    case(TUBE)  # compared with Euler's load
    case(TUBE | {"effective_length": 0.5})
    case(TUBE, ["section.a.thickness=2e-3"], **WIND)
    case(TUBE, ["section.a.thickness=2e-3", "section.a.effective_length=0.5"], **STRUT)
    stages = [{"static": {}}, {"time": {"integrator": "newmark", "step": 1e-5, "end": 1e-4}, **WIND}]
    data = case({}).to_dict()
    del data["time"]
    data["section"]["a"]["diameter"] = 0.1
    assert Case.from_dict(data | {"stage": stages}).section["a"].diameter == 0.1


def test_keys_that_lose_their_effect():
    made = case({"diameter": 0.1}, **WIND)
    with pytest.raises(InputError, match="section.a.diameter = 0.1: has an effect in wind alone"):
        made.wind = None
    made.update({"wind": None, "section.a.diameter": None})
    assert made.wind is None
