"""Springs and dashpots to the ground, against closed forms of one bar."""

import numpy as np
import pytest
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import open_result

YOUNG, DENSITY, AREA, LENGTH, G = 2e6, 500.0, 1e-3, 2.0, 9.81
BAR = DENSITY * AREA * LENGTH
K = np.array([300.0, 500.0, 200.0])
EXPLICIT = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura"]
IMPLICIT = ["newmark", "wilson", "houbolt", "generalized_alpha", "energy_momentum"]
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}


def case(**tables):
    """A bar that moves as a whole on equal springs at both ends."""
    data = {
        "mesh": {"generator": "rod", "length": LENGTH, "elements": 1},
        "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "spring": [{"node_set": "all", "stiffness": (0.25 * K).tolist()} for _ in range(2)],
        "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
        "solver": {"rtol": 1e-13},
        **tables,
    }
    return Case.from_dict(data)


def time_of(scheme, step, end, mass="lumped"):
    return {"integrator": scheme, "step": step, "end": end, "mass": mass, **PARAMETERS.get(scheme, {})}


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_dashpot(scheme, mass, tmp_path):
    """m v' = -c v of a bar with equal dashpots at both ends: v = v0 exp(-c t/m)."""
    c = 4.0
    it = case(
        spring=[],
        dashpot=[{"node_set": "all", "coefficient": 0.5 * c}],
        time=time_of(scheme, 1e-3, 0.4, mass),
        initial={"velocity": [0.0, 0.3, 0.4]},
    )
    history = run(it, tmp_path / "out", MPI.COMM_SELF)
    t = history["time"]
    np.testing.assert_allclose(
        history["momentum"][:, 1], 0.3 * BAR * np.exp(-c * t / BAR), atol=(3e-3 if scheme == "souza_moura" else 1e-3)
    )
    kinetic = history["kinetic_energy"]
    np.testing.assert_allclose(history["damping_dissipation"], kinetic[0] - kinetic, atol=4e-3 * kinetic[0])
    np.testing.assert_allclose(
        history["momentum"] - history["momentum"][0], history["damping_impulse"], atol=1e-11 * 0.4 * BAR
    )
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * kinetic[0]


@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
def test_static_deflection_and_modes(operator, comm, shared_tmp_path):
    """A chain of rods across its springs: nothing else holds it; reactions are those of the ground."""
    mesh = {"generator": "rod", "length": LENGTH, "elements": 1}
    weight = {"acceleration": [0.0, 0.0, -G]}
    it = case(
        mesh=mesh,
        gravity=weight,
        static={"method": "newton"},
        modes={"count": 6},
        solver={"linear": "cg" if operator == "matrix_free" else "mumps", "operator": operator, "rtol": 1e-12},
    )
    assert Simulation(it, comm, output=shared_tmp_path / "out", quiet=True).run() == 0
    if comm.rank == 0:
        with open_result(shared_tmp_path / "out") as result:
            history = result.history
            sag = BAR * G / K[2]
            assert history["probe/end/position"][-1, 0, 2] == pytest.approx(-sag, rel=1e-10)
            assert history["support_force"][-1, 2] == pytest.approx(BAR * G, rel=1e-10)
            assert history["spring_energy"][-1] == pytest.approx(0.5 * K[2] * sag**2, rel=1e-9)
            assert history["external_work"][-1] == pytest.approx(0.5 * K[2] * sag**2, rel=1e-9)
            # both ends in and out of phase: the bar resists out of phase along x only
            squares = np.concatenate([K / BAR, K[1:] / BAR, [(K[0] + 4.0 * YOUNG * AREA / LENGTH) / BAR]])
            np.testing.assert_allclose(result.modes.eigenvalue, np.sort(squares), rtol=1e-8)


def test_critical_step(tmp_path):
    """2/w with bar and springs; dashpots reduce it where the scheme's limit depends on damping."""
    top = np.sqrt((K[0] + 4.0 * YOUNG * AREA / LENGTH) / BAR)
    steps = {}
    for c in (0.0, 20.0):
        for scheme in ("central_differences", "chung_lee"):
            it = case(
                dashpot=[{"node_set": "end", "coefficient": c}], time={**time_of(scheme, "auto", 0.1), "safety": 0.9}
            )
            with Simulation(it, MPI.COMM_SELF, output=tmp_path / f"{scheme}{c}", quiet=True) as simulation:
                steps[scheme, c] = simulation.plan.critical_step
    assert steps["central_differences", 0.0] == pytest.approx(2.0 / top, rel=1e-6)
    assert steps["central_differences", 20.0] == steps["central_differences", 0.0]
    assert steps["chung_lee", 20.0] < 0.99 * steps["chung_lee", 0.0]


FRAME = [[1.0, 2.0, -0.5], [0.3, -1.0, 1.0]]


def axes():
    """Rows: the axes of the frame, by Gram and Schmidt."""
    x, y = np.array(FRAME)
    x = x / np.linalg.norm(x)
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_frame(scheme, operator, tmp_path):
    """A bar that moves as a whole: along each axis of the frame u = v/w sin(w t), beside springs along the model's."""
    if operator == "matrix_free" and scheme not in ("newmark", "generalized_alpha"):
        pytest.skip("one scheme of a kind is enough")
    v, both = axes().T @ [0.05, 0.1, -0.2], {"node_set": "all", "stiffness": (0.25 * K).tolist(), "frame": FRAME}
    twice = [both, {**both, "stiffness": (0.2 * K).tolist()}, {"node_set": "all", "stiffness": [5.0, 5.0, 5.0]}]
    solver = {"rtol": 1e-13} | ({"operator": operator, "linear": "cg"} if operator == "matrix_free" else {})
    it = case(spring=twice, time=time_of(scheme, 1e-3, 0.4), initial={"velocity": v.tolist()}, solver=solver)
    history = run(it, tmp_path / "out", MPI.COMM_SELF)
    stiff = 0.9 * K + 10.0
    omega, t = np.sqrt(stiff / BAR), history["time"][:, None]
    moved = (history["centre_of_mass"] - history["centre_of_mass"][0]) @ axes().T
    exact = np.array([0.05, 0.1, -0.2]) / omega * np.sin(omega * t)
    assert np.abs(moved - exact).max() < (0.03 if scheme == "souza_moura" else 1e-3) * np.abs(exact).max()
    scale = history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * scale
    assert history["spring_energy"][-1] == pytest.approx(0.5 * (stiff * moved[-1] ** 2).sum(), rel=1e-3)
    gained = history["momentum"] - history["momentum"][0]
    np.testing.assert_allclose(gained, history["support_impulse"], atol=1e-10 * np.abs(BAR * v).max())
    if scheme == "energy_momentum":
        assert np.abs(history["numerical_dissipation"]).max() < 1e-12 * scale


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_reactions_of_the_ground(scheme, comm, shared_tmp_path):
    """A bar that moves as a whole on inclined springs and dashpots, one end held along x: node by node -K u - c v."""
    v, c, tensor = np.array([0.0, 0.1, -0.2]), 0.3, 0.5 * np.diag(K)
    frame = [[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.5**0.5, 0.5**0.5], [0.0, -(0.5**0.5), 0.5**0.5]])
    tensor = turn.T @ tensor @ turn
    it = case(
        spring=[{"node_set": "all", "stiffness": (0.25 * K).tolist(), "frame": frame} for _ in range(2)],
        dashpot=[{"node_set": "all", "coefficient": c}],
        support=[{"node_set": "start", "fix": "x"}],
        time=time_of(scheme, 1e-3, 0.3),
        initial={"velocity": v.tolist()},
        output={"fields_every": 0, "probe": [{"name": "all", "node_set": "all"}]},
    )
    history = run(it, shared_tmp_path / "out", comm)
    reactions, velocities = history["probe/all/reaction"], history["probe/all/velocity"]
    moved = history["probe/all/position"] - [[0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0]]
    expected, held = -np.einsum("ij,tnj->tni", tensor, moved) - c * velocities, reactions[:, 0, 0].copy()
    reactions[:, 0, 0] = expected[:, 0, 0] = 0.0
    np.testing.assert_allclose(reactions, expected, atol=1e-12 * np.abs(expected).max())
    dashpots = -c * velocities.sum(axis=1)
    reactions[:, 0, 0] = held
    scale = np.abs(reactions).max()
    np.testing.assert_allclose(reactions.sum(axis=1), history["support_force"] + dashpots, atol=1e-10 * scale)
    # closed form along the axes of the springs, each an oscillator of the whole bar
    stiff, t = K[1:], history["time"][:, None]
    decay = c / BAR
    omega = np.sqrt(stiff / BAR - decay**2)
    u = (turn @ v)[1:] / omega * np.exp(-decay * t) * np.sin(omega * t)
    rate = (turn @ v)[1:] * np.exp(-decay * t) * np.cos(omega * t) - decay * u
    exact = -0.5 * stiff * u - c * rate
    error = np.abs(reactions[:, 1] @ turn.T[:, 1:] - exact).max() / np.abs(exact).max()
    assert error < (0.03 if scheme == "souza_moura" else 2e-3)


@pytest.mark.parallel
def test_reactions_of_springs_in_statics(comm, shared_tmp_path):
    """A tripod whose feet stand on springs: 45 and 55 % of the load up, by moments; a bar that goes changes nothing."""
    points = [[0, 0, 0], [1, 0, 1], [2, 0, 0], [1, 0, 0.5]]
    bars = [[0, 1], [1, 2], [0, 2], [0, 3], [3, 2], [3, 1]]
    groups = {"a": [0], "b": [1], "c": [2], "all": [0, 1, 2, 3]}
    data = {
        "mesh": {"generator": "arrays", "points": points, "bars": bars, "node_groups": groups}
        | {"bar_groups": {"mast": [5]}},
        "node_set": {name: {"group": name} for name in groups},
        "material": {"m": {"young_modulus": 2e11, "density": 1.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "all", "fix": "y"}, {"node_set": "a", "fix": "x"}],
        "spring": [
            {"node_set": "a", "stiffness": [0.0, 0.0, 1e8]},
            {"node_set": "c", "stiffness": [0.0, 0.0, 2e8]},
        ],
        "dashpot": [{"node_set": "all", "coefficient": 1e3}],
        "output": {"probe": [{"name": name, "node_set": name} for name in groups]},
        "solver": {"rtol": 1e-12},
        "stage": [
            {"name": "loading", "static": {"step": 0.5}, "load": [{"node_set": "b", "force": [100.0, 0.0, -1000.0]}]},
            {"name": "without", "static": {"step": 1.0}, "remove": [{"bars": "mast", "time": 0.0, "duration": 1.0}]},
        ],
    }
    history = run(Case.from_dict(data), shared_tmp_path / "out", comm)
    for row in (2, -1):
        feet = history["probe/a/reaction"][row, 0], history["probe/c/reaction"][row, 0]
        np.testing.assert_allclose(feet, [[-100.0, 0.0, 450.0], [0.0, 0.0, 550.0]], atol=0.05)
    sums = history["probe/all/reaction"].sum(axis=1)
    np.testing.assert_allclose(sums, history["support_force"], atol=1e-6)
    sunk = history["probe/c/position"][:, 0, 2]
    np.testing.assert_allclose(history["probe/c/reaction"][:, 0, 2], -2e8 * sunk, rtol=1e-12, atol=1e-12)
    assert np.abs(history["probe/b/reaction"]).max() < 1e-8


@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
def test_frame_in_statics_modes_and_critical_steps(operator, comm, shared_tmp_path):
    """A weight that moves its bar aside; modes and the explicit limit of stiffness along the bar and across."""
    tensor = 0.5 * axes().T @ np.diag(K) @ axes()  # of each node
    springs = [{"node_set": "all", "stiffness": (0.5 * K).tolist(), "frame": FRAME}]
    it = case(
        spring=springs,
        gravity={"acceleration": [0.0, 0.0, -G]},
        static={"method": "newton"},
        modes={"count": 6},
        solver={"linear": "cg" if operator == "matrix_free" else "mumps", "operator": operator, "rtol": 1e-12},
    )
    assert Simulation(it, comm, output=shared_tmp_path / "out", quiet=True).run() == 0
    sag = np.linalg.solve(2.0 * tensor, [0.0, 0.0, -BAR * G])
    axial = YOUNG * AREA / LENGTH * np.outer([1, 0, 0], [1, 0, 0])
    full = np.block([[tensor + axial, -axial], [-axial, tensor + axial]])
    squares = np.linalg.eigvalsh(full) / (0.5 * BAR)
    if comm.rank == 0:
        with open_result(shared_tmp_path / "out") as result:
            moved = result.history["centre_of_mass"][-1] - result.history["centre_of_mass"][0]
            np.testing.assert_allclose(moved, sag, rtol=1e-8)
            np.testing.assert_allclose(result.history["support_force"][-1], [0.0, 0.0, BAR * G], atol=1e-8 * BAR * G)
            np.testing.assert_allclose(result.modes.eigenvalue, squares, rtol=1e-7)
    shaken = case(spring=springs, time={**time_of("central_differences", "auto", 0.1), "safety": 0.9})
    with Simulation(shaken, comm, output=shared_tmp_path / "auto", quiet=True) as simulation:
        assert simulation.plan.critical_step == pytest.approx(2.0 / np.sqrt(squares[-1]), rel=1e-5)


def test_refusals(tmp_path):
    some = {"time": time_of("newmark", 1e-3, 1e-3)}
    with pytest.raises(InputError, match=r"spring\[0\].stiffness = .*expected values >= 0"):
        case(**some, spring=[{"node_set": "end", "stiffness": [1.0, -1.0, 0.0]}])
    with pytest.raises(InputError, match=r"spring\[0\].*the two vectors of frame are parallel"):
        case(**some, spring=[{"node_set": "end", "stiffness": [1.0, 1.0, 0.0], "frame": [[1, 0, 0], [2, 0, 0]]}])
    with pytest.raises(InputError, match=r"spring\[0\].*frame defines the axes of springs to the ground"):
        between = {"between": ["start", "end"], "stiffness": 1.0, "frame": [[1, 0, 0], [0, 1, 0]]}
        case(**some, spring=[between])
    with pytest.raises(InputError, match=r"dashpot\[0\].node_set"):
        case(**some, dashpot=[{"node_set": "ende", "coefficient": 1.0}])
    for method in ("arc_length", "relaxation"):
        with pytest.raises(InputError, match=f'spring: static.method = "{method}" does not support springs'):
            Simulation(case(static={"method": method}), MPI.COMM_SELF, output=tmp_path / method, quiet=True)
    wall = {"name": "w", "type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0], "node_set": "start"}
    massless = {"wall": [wall], "contact": {"treatment": "mass_redistribution"}, **some}
    with pytest.raises(InputError, match=r"a node without mass cannot have a \[\[spring\]\]"):
        Simulation(case(**massless), MPI.COMM_SELF, output=tmp_path / "m", quiet=True)
