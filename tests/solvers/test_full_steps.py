"""Full Newton steps where the residual rises first, what is repeated with a line search, and what is a limit point."""

import numpy as np
import pytest
from petsc4py import PETSc

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import SimulationFailure

GRAVITY, STEP = 9.81, 0.04186
PENDULUM = {
    "mesh": {"generator": "arrays", "points": [[0, 0, 0], [1, 0, 0]], "bars": [[0, 1]]},
    "node_set": {"a": {"indices": [0]}, "b": {"indices": [1]}},
    "material": {"m": {"young_modulus": 1e8, "density": 1.0}},
    "section": {"s": {"area": 1.0, "material": "m"}},
    "support": [{"node_set": "a", "fix": "xyz"}, {"node_set": "b", "fix": "y"}],
    "gravity": {"acceleration": [0.0, 0.0, -GRAVITY]},
    "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": STEP, "end": 20 * STEP, "mass": "consistent"},
    "solver": {"guard": False},
    "output": {"fields_every": 0, "probe": [{"name": "b", "node_set": "b"}]},
}


def run(case, comm, folder):
    with Simulation(case, comm, output=folder / "out", quiet=True) as simulation:
        simulation.run()
    return open_result(folder / "out" / "result.vtkhdf").history


def angles(count, parts=200):
    """Angles below the horizontal of a rigid uniform bar that falls from there, theta'' = 1.5 g cos(theta) / L."""
    state, h, found = np.zeros(2), STEP / parts, [0.0]

    def rate(y):
        return np.array([y[1], 1.5 * GRAVITY * np.cos(y[0])])

    for k in range(count * parts):
        a = rate(state)
        b = rate(state + 0.5 * h * a)
        c = rate(state + 0.5 * h * b)
        state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(state + h * c))
        if (k + 1) % parts == 0:
            found.append(state[0])
    return np.array(found)


@pytest.mark.parallel
def test_a_stiff_pendulum_takes_few_iterations(comm, shared_tmp_path, capsys):
    history = run(Case.from_dict(PENDULUM), comm, shared_tmp_path)
    assert "bisecting" not in capsys.readouterr().err
    assert history["newton_iterations"][1:].max() <= 6
    x, _, z = history["probe/b/position"][:, 0].T
    np.testing.assert_allclose(np.unwrap(np.arctan2(-z, x)), angles(20), atol=0.03)
    np.testing.assert_allclose(np.hypot(x, z), 1.0, atol=1e-6)


def test_the_line_search_of_the_user_is_the_only_one(comm, shared_tmp_path):
    """It takes tens of iterations where full steps take at most six."""
    options = PETSc.Options()
    options["pfem_snes_linesearch_type"] = "bt"
    try:
        data = PENDULUM | {"time": PENDULUM["time"] | {"end": 8 * STEP}}
        history = run(Case.from_dict(data), comm, shared_tmp_path)
    finally:
        options.delValue("pfem_snes_linesearch_type")
    assert history["newton_iterations"].max() > 10


def stiff_and_soft(seed, ratio, turn=1e-4, nodes=20):
    """A truss of random nodes, each on three or more earlier ones, and its linear solution, which turns bars little."""
    chance = np.random.default_rng(seed)
    points, bars = chance.uniform(0.0, 1.0, (nodes, 3)), []
    for i in range(3, nodes):
        near = np.argsort(np.linalg.norm(points[:i] - points[i], axis=1))
        bars += [[int(j), i] for j in near[: 3 + (chance.random() < 0.35)]]
    stiffness = 1e5 * ratio ** -chance.random(len(bars))
    force = chance.normal(size=(nodes, 3))
    matrix = np.zeros((nodes, 3, nodes, 3))
    for (i, j), k in zip(bars, stiffness, strict=True):
        way = points[j] - points[i]
        block = k / np.linalg.norm(way) ** 3 * np.outer(way, way)
        matrix[i, :, i] += block
        matrix[j, :, j] += block
        matrix[i, :, j] -= block
        matrix[j, :, i] -= block
    u = np.zeros((nodes, 3))
    u[3:] = np.linalg.solve(matrix[3:, :, 3:].reshape(3 * nodes - 9, -1), force[3:].ravel()).reshape(-1, 3)
    i, j = np.array(bars).T
    factor = turn / (np.linalg.norm(u[j] - u[i], axis=1) / np.linalg.norm(points[j] - points[i], axis=1)).max()
    free = range(3, nodes)
    tables = {
        "node_set": {"base": {"indices": [0, 1, 2]}, **{f"n{k}": {"indices": [k]} for k in free}},
        "material": {f"m{k}": {"young_modulus": 1e4 * ea, "density": 1e3} for k, ea in enumerate(stiffness)},
        "section": {f"s{k}": {"bars": f"g{k}", "area": 1e-4, "material": f"m{k}"} for k in range(len(bars))},
        "support": [{"node_set": "base", "fix": "xyz"}],
        "load": [{"node_set": f"n{k}", "force": (factor * force[k]).tolist()} for k in free],
        "static": {"step": 1.0},
        "output": {"fields_every": 0, "probe": [{"name": f"n{k}", "node_set": f"n{k}"} for k in free]},
    }
    truss = Truss(points, np.array(bars), bar_groups={f"g{k}": [k] for k in range(len(bars))})
    return Case(tables, mesh=truss), points[3:], factor * u[3:]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("ratio", "seed"), [(1e6, 5), (1e7, 5), (1e8, 4)])
def test_stiffnesses_of_very_different_size(ratio, seed, comm, shared_tmp_path, capsys):
    case, points, expected = stiff_and_soft(seed, ratio)
    history = run(case, comm, shared_tmp_path)
    assert "halving" not in capsys.readouterr().err
    assert history["newton_iterations"].sum() <= 3
    found = np.stack([history[f"probe/n{k}/position"][-1, 0] for k in range(3, 20)]) - points
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


VON_MISES_LIMIT = 0.38109
"""2 E A (1 - (b / L0)^(2/3))^(3/2) over the load."""


def failure(comm, folder, **changes):
    data = Case.load("von_mises").to_dict() | changes
    with pytest.raises(SimulationFailure) as error:
        run(Case.from_dict(data), comm, folder)
    text = str(error.value)
    return float(text.split("beyond load factor ")[1].split()[0]), text


@pytest.mark.parametrize("step", [0.1, 0.3])
def test_full_steps_do_not_jump_over_a_limit_point(step, comm, shared_tmp_path):
    reached, text = failure(comm, shared_tmp_path, static={"method": "newton", "step": step})
    assert VON_MISES_LIMIT - 0.002 * step < reached < VON_MISES_LIMIT
    assert "it is a limit point: the stiffness becomes singular there" in text


def test_a_limit_point_is_told_only_where_the_stiffness_shows_it(comm, shared_tmp_path):
    static = {"method": "newton", "step": 0.2, "min_step": 0.1}
    reached, text = failure(comm, shared_tmp_path, static=static, solver={"max_newton": 1})
    assert reached == 0.0
    assert "the stiffness shows no limit point" in text
    assert "it is a limit point" not in text


def yielding_bar(speed, h, count, stress, hardening):
    """Elongations of a bar of unit stiffness and mass whose ends fly apart, by the trapezoidal rule and bisection."""
    e = a = plastic = hardened = 0.0
    v, found = speed, [0.0]

    def law(elongation):
        trial = elongation - plastic
        slip = max(abs(trial) - stress - hardening * hardened, 0.0) / (1.0 + hardening)
        return trial - np.sign(trial) * slip, slip

    for _ in range(count):

        def unbalance(new, start=e + h * v + 0.25 * h * h * a):
            return (new - start) + h * h * law(new)[0]  # each end has half of the mass

        low, high = e - 10.0 * h * speed, e + 10.0 * h * speed
        for _ in range(100):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if unbalance(middle) < 0.0 else (low, middle)
        force, slip = law(low)
        plastic, hardened = plastic + np.sign(force) * slip, hardened + slip
        e, v, a = low, v + 0.5 * h * (a - 4.0 * force), -4.0 * force
        found.append(e)
    return np.array(found)


@pytest.mark.parallel
def test_full_steps_that_alternate_between_yield_in_tension_and_in_compression_end(comm, shared_tmp_path, capsys):
    speed, step, count, stress, hardening = 0.06, 2.0, 5, 0.01, 0.02
    ends = {f"n{k}": {"indices": [k]} for k in range(2)}
    tables = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": ends,
        "material": {
            "m": {"young_modulus": 1.0, "density": 1.0, "yield_stress": stress, "isotropic_hardening": hardening}
        },
        "section": {"s": {"area": 1.0, "material": "m"}},
        "initial": {"on": [{"node_set": "n1", "velocity": [speed, 0.0, 0.0]}]},
        "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": step, "end": count * step},
        "solver": {"guard": False},
        "output": {"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in ends]},
    }
    history = run(Case.from_dict(tables), comm, shared_tmp_path)
    assert "bisecting" not in capsys.readouterr().err
    length = np.diff([history[f"probe/{name}/position"][:, 0, 0] for name in ends], axis=0)[0]
    np.testing.assert_allclose(length - 1.0, yielding_bar(speed, step, count, stress, hardening), atol=1e-10)
