"""Drag of bars in wind, against closed forms and a plain evaluation."""

import numpy as np
import pytest
from helpers.meshes import every_node
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.stepping.model import Model

SCHEMES = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura", "newmark", "wilson", "houbolt"]
SCHEMES += ["generalized_alpha", "energy_momentum"]
TRAPEZOID = {"beta": 0.25, "gamma": 0.5}
AREA, DENSITY, G = 1e-4, 500.0, 9.81
DIAMETER = 2.0 * np.sqrt(AREA / np.pi)


def case(scheme="newmark", step=5e-3, end=3.0, **tables):
    parameters = TRAPEZOID if scheme == "newmark" else {}
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 2.0, "elements": 1},
            "node_set": {"start": {"group": "start"}, "all": {"all": True}},
            "material": {"m": {"young_modulus": 1e7, "density": DENSITY}},
            "section": {"s": {"area": AREA, "material": "m"}},
            "gravity": {"acceleration": [0.0, 0.0, -G]},
            "wind": {"velocity": [0.0, 0.0, 0.0]},
            "time": {"integrator": scheme, "step": step, "end": end, **parameters},
            "output": {"fields_every": 0, "probe": [{"name": "all", "node_set": "all"}]},
            "solver": {"linear": "cg", "rtol": 1e-12},
            **tables,
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_falling_bar(scheme, tmp_path):
    """A bar across its way: v = v_t tanh(g t/v_t) with m g = rho C_d d l v_t^2/2; what it loses is the work of drag."""
    wind = {"velocity": [0.0, 0.0, 0.0], "density": 1.5, "drag_coefficient": 1.1}
    the_case = case(
        scheme,
        2e-4 if scheme in ("central_differences", "chung_lee", "hulbert_chung", "souza_moura") else 5e-3,
        wind=wind,
    )
    history = run(the_case, tmp_path / "out", MPI.COMM_SELF)
    terminal = np.sqrt(2.0 * DENSITY * AREA * G / (1.5 * 1.1 * DIAMETER))
    exact = terminal * np.tanh(G * history["time"] / terminal)
    found = -history["probe/all/velocity"][:, 0, 2]
    assert np.abs(found - exact).max() < (5e-3 if scheme == "souza_moura" else 5e-4) * terminal
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()
    falling = case(scheme, wind={**wind, "velocity": [3.0, 4.0, 0.0], "drag_coefficient": 0.0}, end=0.05)
    assert run(falling, tmp_path / "no", MPI.COMM_SELF)["momentum"][-1, :2] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "generalized_alpha"])
def test_angle_of_a_pendulum(scheme, comm, shared_tmp_path):
    """A hinged bar in a horizontal wind comes to rest at the angle b from the vertical, where
    m g sin b = rho C_d d l U^2 cos^2 b / 2."""
    mesh = {"generator": "rod", "length": 2.0, "elements": 1}
    material = {"m": {"young_modulus": 1e7, "density": DENSITY, "damping": 6.0 * DENSITY}}
    speed = 20.0
    the_case = case(
        scheme,
        2e-3 if scheme == "central_differences" else 0.02,
        6.0,
        mesh=mesh,
        material=material,
        support=[{"node_set": "start", "fix": "xyz"}],
        wind={"velocity": [[0.0, 0.0, 0.0, 0.0], [1.0, speed, 0.0, 0.0]]},
        gravity={"acceleration": [0.0, 0.0, -G]},
    )
    history = run(the_case, shared_tmp_path / "out", comm)
    x, z = history["probe/all/position"][-1, 1, [0, 2]]
    stretch = 0.5 * np.hypot(x, z)
    q = stretch * 1.225 * 1.2 * DIAMETER * speed**2 / (2.0 * DENSITY * AREA * G)
    sine = (np.sqrt(1.0 + 4.0 * q * q) - 1.0) / (2.0 * q)
    assert np.arctan2(x, -z) == pytest.approx(np.arcsin(sine), rel=1e-6)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["external_work"].max()


@pytest.mark.parallel
def test_forces_of_a_lattice(comm):
    """Against a loop over bars in NumPy; diameters of sections by key, shape and area; on any number of ranks."""
    sections = {
        "given": {"area": 2e-4, "material": "m", "diameter": 0.05, "bars": "first", "drag_coefficient": 0.7},
        "tube": {"area": 1e-4, "material": "m", "shape": "tube", "thickness": 1e-3},
    }
    the_case = case(
        mesh={"generator": "two_rods", "length": 1.0, "elements": 4, "gap": 0.1},
        node_set={"all": {"all": True}},
        section=sections,
        gravity={"acceleration": [0.0, 0.0, 0.0]},
        wind={"velocity": [[0.0, 1.0, 2.0, 3.0], [2.0, -3.0, 0.0, 1.0]], "density": 2.0, "interpolation": "smooth"},
    )
    rng = np.random.default_rng(5)
    alone = Model(the_case, MPI.COMM_SELF)
    n = alone.mesh.n_nodes
    shift, speeds = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    u = np.array([1.0, 2.0, 3.0]) + 0.5**2 * (3.0 - 2.0 * 0.5) * np.array([-4.0, -2.0, -2.0])
    expected, places = np.zeros((n, 3)), np.empty((n, 3))
    places[alone.mesh.node_ids] = alone.mesh.points
    places = places + 0.1 * shift
    first = set(alone.mesh.bar_ids[alone.mesh.bar_groups["first"]].tolist())
    for number, (a, b) in zip(alone.mesh.bar_ids, alone.mesh.node_ids[alone.mesh.bars]):
        d, c = (0.05, 0.7) if number in first else (1e-4 / (np.pi * 1e-3) + 1e-3, 1.2)
        way = places[b] - places[a]
        length = np.linalg.norm(way)
        w = np.cross(way, np.cross(u - 0.5 * (speeds[a] + speeds[b]), way)) / length**2
        for end in (a, b):
            expected[end] += 0.25 * 2.0 * c * d * length * np.linalg.norm(w) * w
    model = Model(the_case, comm)
    mine = model.mesh.node_ids[: model.mesh.n_owned]
    model.external.follow(places[mine], speeds[mine])
    found = every_node(model, model.external.at(1.0, np.empty((len(mine), 3))))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_bars_that_have_left_have_no_drag(scheme, tmp_path):
    """Nodes of removed bars fly on, those of the others are still driven."""
    the_case = case(
        scheme,
        1e-3,
        0.1,
        mesh={"generator": "two_rods", "length": 1.0, "elements": 2, "gap": 0.1},
        node_set={"all": {"all": True}, "first": {"group": "start"}, "second": {"group": "end"}},
        gravity={"acceleration": [0.0, 0.0, 0.0]},
        wind={"velocity": [0.0, 20.0, 0.0]},
        remove=[{"bars": "second", "time": 0.05}],
        output={"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in ("first", "second")]},
    )
    history = run(the_case, tmp_path / "out", MPI.COMM_SELF)
    first, second = (history[f"probe/{name}/velocity"][:, 0, 1] for name in ("first", "second"))
    assert second[50] == pytest.approx(first[50], rel=1e-9)
    assert first[-1] > 1.5 * first[50]
    assert np.ptp(second[52:]) < 1e-12 * second[50]
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


def test_refusals_and_warnings(tmp_path):
    static = case(support=[{"node_set": "all", "fix": "xyz"}], wind={"velocity": [1.0, 0.0, 0.0]}).to_dict()
    del static["time"]
    static["static"] = {"method": "newton"}
    with pytest.raises(InputError, match="wind: drag turns with the bars"):
        Simulation(Case.from_dict(static), MPI.COMM_SELF, output=tmp_path / "s", quiet=True)
    wall = {"name": "w", "type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0], "node_set": "start"}
    massless = {"wall": [wall], "contact": {"treatment": "mass_redistribution"}}
    with pytest.raises(InputError, match=r"a node without mass cannot follow \[wind\]"):
        Simulation(case(**massless), MPI.COMM_SELF, output=tmp_path / "m", quiet=True)
    strong = case(wind={"velocity": [0.0, 900.0, 0.0], "density": 1000.0})
    with Simulation(strong, MPI.COMM_SELF, output=tmp_path / "t", quiet=True) as simulation:
        assert any("the drag of [wind] stops bars" in text for text in simulation.model.warnings)
    with pytest.raises(InputError, match=r"wind.velocity: this key is missing"):
        case(wind={"density": 1.0})
    with pytest.raises(InputError, match=r"wind.density = -1.0: expected a value > 0"):
        case(wind={"velocity": [1.0, 0.0, 0.0], "density": -1.0})
