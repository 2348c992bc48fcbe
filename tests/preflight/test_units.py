"""Numbers in other units than SI, points far from the mesh, and numbers of bifurcations that no path has."""

import numpy as np
import pytest
from helpers.runs import inspected

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError

STEEL = {"young_modulus": 210e9, "density": 7850.0}
PLASTIC = {"law": "elastoplastic", "isotropic_hardening": 1e9}


def case_with(material=None, section=None, **tables):
    """A bar between two fixed nodes and a free one."""
    data = {
        "node_set": {"feet": {"indices": [0, 2]}},
        "material": {"m": {**STEEL, **(material or {})}},
        "section": {"s": {"area": 1e-4, "material": "m", **(section or {})}},
        "support": [{"node_set": "feet", "fix": "xyz"}],
        "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-3},
        **tables,
    }
    return Case(data, mesh=Truss([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], [[0, 1], [1, 2]]))


@pytest.mark.parametrize(
    "wrong, right, told",
    [
        (
            {"material": {**PLASTIC, "yield_stress": 220.0}},
            {"material": {**PLASTIC, "yield_stress": 220e6}},
            "1.05e-09",
        ),
        ({"material": {**PLASTIC, "yield_stress": 220e3}}, {"material": {**PLASTIC, "yield_stress": 20e6}}, "1.05e-06"),
        ({"material": {"rupture": {"stress": 420.0}}}, {"material": {"rupture": {"stress": 420e6}}}, "2e-09"),
        (
            {"material": {"rupture": {"compressive_stress": 210e3}}},
            {"material": {"rupture": {"compressive_stress": 210e6}}},
            "1e-06",
        ),
        ({"section": {"prestress": 210.0}}, {"section": {"prestress": 210e6}}, "1e-09"),
        ({"section": {"pretension": 10.5}}, {"section": {"pretension": 10.5e3}}, "5e-07"),
        ({"section": {"pretension": [[0.0, 0.0], [1.0, 10.5e6]]}}, {"section": {"pretension": 0.0}}, "0.5"),
    ],
)
def test_stresses_and_forces_in_other_units(wrong, right, told):
    """The strain stress / E, or force / (E A), that no structure has."""
    (key, value) = next(iter(next(iter(wrong.values())).items()))
    text = "\n".join(inspected(case_with(**wrong))[1])
    assert f"a strain of {told}; " in text and "SI units" in text, (key, value)
    assert "a strain of" not in "".join(inspected(case_with(**right))[1])


def test_a_pretension_of_many_lengths(tmp_path):
    """20 kN in a bar of E A = 10 N: its rest length is L / (1 + N / E A), and the force in the mesh is N."""
    material = {"young_modulus": 1e5, "density": 1.0}
    with pytest.raises(InputError, match="does not reach it at any length"):
        Simulation(case_with(material, {"pretension": -20e3}), check_only=True)
    case = case_with(material, {"pretension": 20e3})
    assert "a strain of 2e+03; " in "".join(inspected(case)[1])
    with Simulation(case, output=tmp_path / "out", quiet=True) as simulation:
        np.testing.assert_allclose(simulation.model.bars.rest, 1.0 / 2001.0, rtol=1e-14)
        simulation.run()
    fields = open_result(tmp_path / "out").mesh(-1).cell_data
    np.testing.assert_allclose(fields["axial_force"], 20e3, rtol=1e-12)


@pytest.mark.parallel
def test_a_point_farther_than_the_size_of_the_truss(comm):
    """[2000, 0, 0] for a tip at 2 m, and a point 1.5 m beside it."""
    for away, told in ((1998.0, True), (1.5, False)):
        node_set = {"feet": {"indices": [0, 2]}, "tip": {"nearest": [2.0 + away, 0.0, 0.0]}}
        _, warnings = inspected(case_with(node_set=node_set), comm)
        far = "node_set.tip.nearest: the nearest node is node 2, 1.998 km away"
        assert any(far in text for text in warnings) == told


def test_numbers_of_bifurcations_that_no_path_has(tmp_path):
    """The arch of two bars has one free component; of a dome with 15, a path with fewer bifurcations says so."""
    case = Case.load("von_mises").to_dict()
    case["static"] |= {"method": "arc_length", "branch_at": [99]}
    with pytest.raises(InputError, match=r"static.branch_at = \[99\]: .* with 1 free components"):
        Simulation(Case.from_dict(case), output=tmp_path / "a", quiet=True)
    case["static"]["branch_at"] = [1]
    with Simulation(Case.from_dict(case), output=tmp_path / "b", quiet=True) as simulation:
        simulation.run()
    log = (tmp_path / "b" / "log.txt").read_text()
    assert "static.branch_at = [1]: the path has no such bifurcation, only 0" in log


@pytest.mark.parallel
def test_areas_of_the_mesh_in_square_millimetres(comm):
    """As a number does, the largest of a field tells; the rank that has it does not matter."""
    for area, told in ((2e-4, False), (200.0, True)):
        mesh = Truss([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], [[0, 1], [1, 2]], bar_fields={"A": [1e-4, area]})
        section = {"s": {"area_field": "A", "material": "m"}}
        support = {"node_set": "feet", "fix": "xyz"}
        data = {"node_set": {"feet": {"indices": [0, 2]}}, "material": {"m": STEEL}, "section": section}
        data |= {"support": [support], "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-3}}
        data["node_set"] |= {"left": {"indices": [0]}, "right": {"indices": [2]}}
        data["spring"] = [{"between": ["left", "right"], "stiffness": 1.0}]  # whose bars are of no section of the case
        case = Case(data, mesh=mesh)
        _, warnings = inspected(case, comm)
        text = "section.s.area_field = 'A' has areas up to 200 m2: no bar has that; 1 mm2 is 1e-6 m2"
        assert any(text in warning for warning in warnings) == told
