"""Form finding by force densities and by given forces, against closed forms; values of prestress by bar."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import check_balances
from helpers.stopped import assert_restart_is_bitwise
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError, SimulationFailure

CABLE = {"law": "cable", "young_modulus": 1.6e11, "density": 7850.0}
E_A = 1.6e11 * 1e-4
BUILT = [{"name": "form", "static": {"method": "force_density"}}, {"name": "built", "static": {"step": 1.0}}]


def run(data, comm, folder):
    with Simulation(Case.from_dict(data, name="net"), comm, output=folder, quiet=True) as simulation:
        simulation.run()
    comm.Barrier()
    return open_result(folder)


def net(cells=6, **section):
    """A net over a square whose edges are on z = x y/8; inside, nodes are anywhere."""
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    i, j = np.divmod(number.ravel(), cells + 1)
    x, y = 8.0 * i / cells - 4.0, 8.0 * j / cells - 4.0
    edge = (i % cells == 0) | (j % cells == 0)
    points = np.column_stack([x + 0.1 * ~edge * np.sin(j), y, np.where(edge, x * y / 8.0, 0.3 * np.sin(i))])
    bars = np.vstack(
        [
            np.column_stack([number[:-1, 1:-1].ravel(), number[1:, 1:-1].ravel()]),
            np.column_stack([number[1:-1, :-1].ravel(), number[1:-1, 1:].ravel()]),
        ]
    )
    corners = np.isin(number.ravel(), number[[0, 0, -1, -1], [0, -1, 0, -1]])
    new = np.cumsum(~corners) - 1
    data = {
        "mesh": Truss(points[~corners], new[bars]),
        "material": {"m": CABLE},
        "section": {"s": {"area": 1e-4, "material": "m", **section}},
        "node_set": {
            "edge": {"indices": new[edge & ~corners].tolist()},
            "inside": {"indices": new[~edge].tolist()},
        },
        "support": [{"node_set": "edge", "fix": "xyz"}],
        "stage": BUILT,
    }
    return data, np.column_stack([x, y, x * y / 8.0])[~corners], new[bars]


def lengths(points, bars):
    return np.linalg.norm(points[bars[:, 1]] - points[bars[:, 0]], axis=1)


@pytest.mark.parallel
def test_hypar_and_the_net_as_built(comm, shared_tmp_path):
    """With the same force density everywhere, a net with nodes of a hyperbolic paraboloid at its edges is one."""
    data, form, bars = net(force_density=2000.0)
    result = run(data, comm, shared_tmp_path / "out")
    np.testing.assert_allclose(result.positions(1), form, atol=1e-13)
    length = lengths(form, bars)
    np.testing.assert_allclose(result.field("axial_force", 1), 2000.0 * length, rtol=1e-11)
    np.testing.assert_allclose(result.field("rest_length", 1), length / (1.0 + 2000.0 * length / E_A), rtol=1e-12)
    # the next stage has the net with its forces, and moves nothing
    np.testing.assert_allclose(result.positions(2), form, atol=1e-12)
    np.testing.assert_allclose(result.field("axial_force", 2), 2000.0 * length, rtol=1e-9)
    history = {name: result.history[name] for name in result.history}
    check_balances(history)
    gain = history["elastic_energy"][1] - history["elastic_energy"][0]
    assert history["prestress_work"][1] == pytest.approx(gain, rel=1e-9)
    assert "form found by 1 linear solve: unstressed lengths" in (shared_tmp_path / "out" / "log.txt").read_text()


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_after_the_form(comm, shared_tmp_path, monkeypatch):
    # PT-Scotch may divide the mesh otherwise at a second call in one process
    monkeypatch.setattr("pfem_petsc.mesh.ordering._by_graph", lambda slab, comm: None)
    data, _, _ = net(force_density=2000.0)
    snow = {"name": "snow", "static": {"step": 0.5}, "load": [{"node_set": "inside", "force": [0.0, 0.0, -50.0]}]}
    case = Case.from_dict({**data, "stage": [*BUILT, snow], "solver": {"linear": "cg"}})
    assert_restart_is_bitwise(case, comm, shared_tmp_path, 1, 2, 3)


def test_cable_under_loads_is_a_parabola(tmp_path):
    """q (z_{i+1} - 2 z_i + z_{i-1}) = P, by hand; supports that hold one component are those of that component."""
    n, span, density, weight = 10, 20.0, 500.0, 80.0
    x = np.linspace(0.0, span, n + 1)
    points = np.column_stack([x + 0.3 * np.sin(x), np.zeros(n + 1), 0.1 * np.sin(x)])
    points[[0, -1]] = [[0.0, 0.0, 0.0], [span, 0.0, 1.0]]
    data = {
        "mesh": Truss(points, [(i, i + 1) for i in range(n)]),
        "material": {"m": CABLE},
        "section": {"s": {"area": 1e-4, "material": "m", "force_density": density}},
        "node_set": {"ends": {"indices": [0, n]}, "inside": {"indices": list(range(1, n))}},
        "support": [{"node_set": "ends", "fix": "xyz"}, {"node_set": "inside", "fix": "y"}],
        "load": [{"node_set": "inside", "force": [0.0, 0.0, -weight]}],
        "static": {"method": "force_density"},
    }
    found = run(data, MPI.COMM_SELF, tmp_path / "out").positions(-1)
    i = np.arange(n + 1)
    expected = 0.5 * weight / density * i * (i - n) + i / n
    np.testing.assert_allclose(found, np.column_stack([span * i / n, 0.0 * x, expected]), atol=1e-11)


def test_given_forces_are_those_of_fermat_and_of_a_triangle(tmp_path):
    """Three cables with equal forces meet at 120 degrees; with 3, 4 and 5 N two of them at a right angle."""
    corners = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [1.0, 4.0, 0.0]])
    points = np.vstack([corners, [[2.0, 1.0, 0.5]]])
    for k, forces in enumerate(([1e3, 1e3, 1e3], [3e3, 4e3, 5e3])):
        data = {
            "mesh": Truss(points, [(3, 0), (3, 1), (3, 2)], bar_fields={"force": np.array(forces)}),
            "material": {"m": CABLE},
            "section": {"s": {"area": 1e-4, "material": "m", "pretension_field": "force"}},
            "node_set": {"corners": {"indices": [0, 1, 2]}},
            "support": [{"node_set": "corners", "fix": "xyz"}],
            "stage": [{**BUILT[0], "static": {"method": "force_density", "tolerance": 1e-12}}, BUILT[1]],
        }
        result = run(data, MPI.COMM_SELF, tmp_path / str(k))
        for snapshot in (1, 2):
            np.testing.assert_allclose(result.field("axial_force", snapshot), forces, rtol=1e-9)
        way = corners - result.positions(1)[3]
        one, two, three = way / np.linalg.norm(way, axis=1, keepdims=True)
        if k == 0:
            assert [one @ two, two @ three, three @ one] == pytest.approx([-0.5] * 3, abs=1e-8)
        else:
            assert one @ two == pytest.approx(0.0, abs=1e-8)


def test_given_lengths_are_those_of_a_tripod_and_of_a_chain(tmp_path):
    """A weight on three cables hangs where spheres around their ends meet; two pairs of equal bars by Pythagoras."""
    corners, hung = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [1.0, 4.0, 0.0]]), np.array([1.8, 1.5, -2.5])
    points = np.vstack([corners, [[2.0, 1.0, 0.0]]])
    given = np.linalg.norm(corners - hung, axis=1)
    common = {
        "material": {"m": CABLE},
        "stage": [{**BUILT[0], "static": {"method": "force_density", "tolerance": 1e-12}}, BUILT[1]],
    }
    tripod = common | {
        "mesh": Truss(points, [(3, 0), (3, 1), (3, 2)], bar_fields={"cut": given}),
        "section": {"s": {"area": 1e-4, "material": "m", "target_length_field": "cut"}},
        "node_set": {"corners": {"indices": [0, 1, 2]}, "weight": {"indices": [3]}},
        "support": [{"node_set": "corners", "fix": "xyz"}],
        "load": [{"node_set": "weight", "force": [0.0, 0.0, -900.0]}],
    }
    result = run(tripod, MPI.COMM_SELF, tmp_path / "tripod")
    for snapshot in (1, 2):
        np.testing.assert_allclose(result.positions(snapshot)[3], hung, atol=1e-9)
    # the forces that balance the weight, and the cut lengths
    force = np.linalg.solve(((corners - hung) / given[:, None]).T, [0.0, 0.0, 900.0])
    np.testing.assert_allclose(result.field("axial_force", 1), force, rtol=1e-8)
    np.testing.assert_allclose(result.field("rest_length", 1), given / (1.0 + force / E_A), rtol=1e-9)

    ends = common | {
        "mesh": Truss([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [(0, 1), (1, 2), (2, 3)]),
        "section": {"s": {"area": 1e-4, "material": "m", "target_length": 1.3}},
        "node_set": {"ends": {"indices": [0, 3]}, "inside": {"indices": [1, 2]}},
        "support": [{"node_set": "ends", "fix": "xyz"}],
        "load": [{"node_set": "inside", "force": [0.0, 0.0, -50.0]}],
    }
    found = run(ends, MPI.COMM_SELF, tmp_path / "chain").positions(1)
    x, deep = 0.5 * (3.0 - 1.3), -np.sqrt(1.3**2 - 0.25 * 1.7**2)
    np.testing.assert_allclose(found, [[0, 0, 0], [x, 0, deep], [x + 1.3, 0, deep], [3, 0, 0]], atol=1e-9)

    ends["section"]["s"]["target_length"] = 0.9  # shorter than the way between the supports
    with pytest.raises(SimulationFailure, match="a chain is too short for its supports"):
        run(ends, MPI.COMM_SELF, tmp_path / "short")
    ends["stage"] = [BUILT[1]]
    with pytest.raises(InputError, match="target_length: lengths are found in a form"):
        Simulation(Case.from_dict(ends), check_only=True)


@pytest.mark.parallel
@pytest.mark.parametrize("key", ["pretension_field", "rest_length_field", "force_density_field"])
def test_values_of_bars_are_those_of_sections_of_one_bar_each(key, comm, shared_tmp_path):
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.5, 0.0, 0.0], [4.0, 0.0, 0.0]]
    values = {"rest_length_field": [0.99, 1.0, 1.01]}.get(key, [100.0, 0.0, -50.0])
    bars, length = [(0, 1), (1, 2), (2, 3)], np.array([1.0, 1.5, 1.5])
    common = {
        "material": {"m": {"young_modulus": 2e9, "density": 1e3}},
        "node_set": {"base": {"indices": [0]}, "other": {"indices": [1, 2, 3]}},
        "support": [{"node_set": "base", "fix": "xyz"}, {"node_set": "other", "fix": "yz"}],
        "time": {"integrator": "central_differences", "step": 1e-5, "end": 2e-3},
    }
    groups = {f"bar{k}": np.array([k]) for k in range(3)}
    fields = {"v": np.array(values)}
    one = {"s": {"area": 1e-4, "material": "m", key: "v"}}
    each = {
        f"bar{k}": {"area": 1e-4, "material": "m", "bars": f"bar{k}", key.removesuffix("_field"): value}
        for k, value in enumerate(values)
    }
    a = run(
        common | {"mesh": Truss(points, bars, bar_fields=fields), "section": one}, comm, shared_tmp_path / f"a{key}"
    )
    b = run(
        common | {"mesh": Truss(points, bars, bar_groups=groups), "section": each}, comm, shared_tmp_path / f"b{key}"
    )
    np.testing.assert_allclose(a.positions(-1), b.positions(-1), rtol=1e-13, atol=1e-15)
    if key == "rest_length_field":  # cut to these lengths, which have the mass
        forces = 2e9 * 1e-4 * (1.0 / np.array(values) - 1.0)
    else:
        forces = np.array(values) * (length if "density" in key else 1.0)
    np.testing.assert_allclose(a.field("axial_force", 0), forces, rtol=1e-9, atol=1e-9)


def test_mass_is_that_of_given_rest_lengths():
    tables = [{**net(**keys)[0], "stage": None, "static": {}} for keys in ({"rest_length": 1.02}, {"pretension": 1.0})]
    cases = [{key: value for key, value in each.items() if value is not None} for each in tables]
    masses = [Simulation(Case.from_dict(each), check_only=True).model.total_mass for each in cases]
    assert masses[0] == pytest.approx(1.02 * masses[1], rel=1e-12)


@pytest.mark.parametrize(
    ("section", "more", "text"),
    [
        ({}, {}, "needs a force_density .* pretension .*, prestress .* or target_length"),
        ({"rest_length": 0.99}, {}, "needs a force_density"),
        ({"force_density": 1.0, "pretension": 1.0}, {}, "at most one of the keys prestress, pretension, rest_length"),
        ({"force_density_field": "q"}, {}, "has no field of this name"),
        ({"target_length": -1.0}, {}, "target_length = -1.0: expected a value > 0"),
        (
            {"force_density": 1.0},
            {"wall": [{"type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0]}]},
            r"takes no \[\[wall\]\]: give it in a later stage",
        ),
    ],
)
def test_refused(section, more, text):
    data, _, _ = net(**section)
    with pytest.raises(InputError, match=text):
        Simulation(Case.from_dict(data | more), check_only=True)


def test_no_form(tmp_path):
    data, _, _ = net(force_density=2000.0)
    data["section"]["s"]["force_density"] = 0.0
    with pytest.raises(SimulationFailure, match="these force densities have no form"):
        run(data, MPI.COMM_SELF, tmp_path / "free")
    data, _, _ = net(force_density=-2000.0)
    with pytest.raises((SimulationFailure, InputError), match="bars of this law take no compression"):
        run(data, MPI.COMM_SELF, tmp_path / "pushed")
