"""The Hessian of every implicit step is the derivative of its residual: assembled, and as an operator."""

import numpy as np
import pytest
from helpers.lattices import SCHEMES, planes, simulation, tumbling
from helpers.twins import KEYS, SOFTENING
from mpi4py import MPI

from pfem_petsc.contact.frames import NodalFrames, Sliding, SlipForces

pytestmark = pytest.mark.parallel

SPEED = 160.0
"""Wave speed of steel over that of the lattices, by which velocities are larger and steps smaller."""
PLASTIC = {"yield_stress": 250e6, "isotropic_hardening": 1e9, "kinematic_hardening": 2e9}
WALLS = {
    "free": [],
    "plane": planes([[0.3, -0.2, 1.0]], [-0.02], friction=0.4),
    "corner": planes([[1.0, 0.2, 0.3], [0.1, 1.0, -0.2], [-0.3, 0.2, 1.0]], [-0.03, -0.04, -0.07], friction=0.4),
    "smooth": planes([[1.0, 0.2, 0.3], [0.1, 1.0, -0.2], [-0.3, 0.2, 1.0]], [-0.03, -0.04, -0.07]),
    "bowl": [{"type": "sphere", "point": [0.1, 0.05, 0.05], "radius": 0.15, "side": "inside", "friction": 0.5}],
}
BASE = {"node_set": {"base": {"box": [[-1, -1, -1e-3], [1, 1, 1e-3]]}, "side": {"box": [[-1, -1, 1e-3], [1e-3, 1, 1]]}}}
HELD = BASE | {"support": [{"node_set": "base", "fix": "xz"}]}
TURNED = BASE | {"support": [{"node_set": "base", "normal": [0.3, 0.1, 1.0]}]}
POINTS = BASE | {
    "spring": [{"node_set": "side", "stiffness": [1e6, 2e6, 0.0]}, {"between": ["base", "side"], "stiffness": 3e6}],
    "dashpot": [{"node_set": "side", "coefficient": 50.0}],
    "mass": [{"node_set": "side", "value": 0.01}],
}
HOT = {"temperature": [{"table": [[0.0, 0.0], [1e-4, 130.0]]}]}


def struck(walls="free", integrator="newmark", parameters=(), law=(), operator="assembled", **tables):
    """A lattice of steel that spins, with walls near it, as fast as its bars bear."""
    solver = {"rtol": 1e-10, "linear": "cg", "operator": operator}
    case = tumbling(WALLS[walls], integrator, dict(parameters), material=dict(law), solver=solver, **tables)
    case["material"]["m"] = {"young_modulus": 200e9, "density": 7850.0, "thermal_expansion": 1e-5, **dict(law)}
    for key in ("velocity", "angular_velocity"):
        case["initial"][key] = [SPEED * v for v in case["initial"][key]]
    case["time"] |= {"step": 1e-3 / SPEED, "end": 0.05 / SPEED}
    case["gravity"]["acceleration"] = [0.0, 0.0, -100.0 * SPEED**2]
    return case


def largest_error(case, comm, folder, solves=8):
    """Of products of the Hessian with random directions, in the first solves in which nodes slip if walls are rough,
    relative to differences of the residual."""
    run = simulation(case, comm, folder)
    newton, errors, random = run.stepper.newton, [], np.random.default_rng(1 + comm.rank)
    solve, rough = newton.solve, any("friction" in wall for wall in case["wall"])

    def compare(problem, w, *others):
        slips = not rough or (problem.transform.sliding.forces.weight > 0.0).any()
        if len(errors) < solves and any(comm.allgather(bool(slips))):
            at, way = w + 1e-6 * random.normal(size=w.shape), random.normal(size=w.shape)
            run.model.supports.clear(way)
            less, more = np.empty_like(w), np.empty_like(w)
            problem.residual(at - 3e-10 * way, less)
            problem.residual(at + 3e-10 * way, more)
            run.stepper.hessian.update(problem, at)
            x, y = run.stepper.hessian.mat.createVecs()
            x.array[:] = way.ravel()
            run.stepper.hessian.mat.mult(x, y)
            slope = (more - less) / 6e-10
            wrong = y.array.reshape(w.shape) - slope
            errors.append(np.divide(*(comm.allreduce(np.abs(v).max(initial=0.0), op=MPI.MAX) for v in (wrong, slope))))
        return solve(problem, w, *others)

    newton.solve = compare
    for _ in run:
        if len(errors) == solves:
            break
    assert len(errors) == solves
    assert run.row["plastic_heat"] > 0.0 or "yield_stress" not in case["material"]["m"]
    return max(errors)


CASES = {
    **{f"elastic, {strain}": {"law": {"strain": strain}} for strain in ("engineering", "green", "logarithmic")},
    **{f"plastic, {strain}": {"law": PLASTIC | {"strain": strain}} for strain in ("green", "logarithmic")},
    **{f"{name} {given}": {"law": PLASTIC, "integrator": name, "parameters": given} for name, given in SCHEMES},
    "consistent mass": {"parameters": {"mass": "consistent"}, "law": {"damping": 1e6}, **HELD},
    "rate": {"law": KEYS["perzyna"] | {"law": "perzyna", "strain": "green"}},
    "damped": {"law": PLASTIC | {"stiffness_damping": 1e-7}},
    "softened": {"law": PLASTIC | {"softening": SOFTENING}, **HOT},
    "breaking": {"law": {"rupture": {"strain": 1e-3, "steps": 20}}, "walls": "smooth"},
    "held": {"law": PLASTIC, **HELD},
    "held, walls": {"law": PLASTIC, "walls": "smooth", **HELD},
    "held along a direction": TURNED,
    "springs, dashpots, masses": POINTS,
    **{name: {"walls": name, "law": {"strain": "green"}} for name in ("plane", "corner", "smooth", "bowl")},
}


@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("name", CASES)
def test_hessian_is_the_derivative_of_the_residual(name, operator, comm, shared_tmp_path):
    if "energy_momentum" in name and operator == "matrix_free":
        pytest.skip("the Hessian is always assembled")
    # slip along three walls at once is so small that its direction turns within the difference
    allowed = 1e-4 if name == "corner" else 1e-6 if name == "bowl" else 1e-5
    assert largest_error(struck(operator=operator, **CASES[name]), comm, shared_tmp_path) < allowed


def test_derivative_of_friction_along_surfaces_that_turn():
    """The direction of slip that is known is that of a solve before, on other tangent planes."""
    rng = np.random.default_rng(4)
    m, w = 20, 2
    normals = rng.normal(size=(m, w, 3))
    normals /= np.linalg.norm(normals, axis=2)[:, :, None]
    basis = np.concatenate([normals, np.cross(normals[:, :1], normals[:, 1:])], axis=1)
    vectors = rng.normal(size=(2, m, w, 3))
    frames, inverse = NodalFrames(np.arange(m), w), np.linalg.inv(basis)
    frames.inverse, frames.normals, frames.rows[:] = inverse, normals, np.arange(w)
    forces = SlipForces(np.zeros((m, 3)), np.tile([0.3, 0.2], (m, 1)), *vectors, np.full(m, 2.0))
    sliding = Sliding(frames, np.arange(m), forces)
    stiffness, x, way = rng.normal(size=(m, 3, 3)), rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    push = normals.sum(axis=1)  # towards all walls

    def residual(x):
        g = 4.0 * push + np.einsum("mij,mj->mi", stiffness, 0.01 * x)
        return sliding.couple(x, np.einsum("mji,mj->mi", inverse, g))

    slope = (residual(x + 1e-6 * way) - residual(x - 1e-6 * way)) / 2e-6
    pressed = (residual(x)[:, :w] > 0.1).all(axis=1)
    force = np.einsum("mij,mj->mi", 0.01 * stiffness + sliding.stiffness, way)
    exact = np.einsum("mij,mj->mi", sliding.maps, np.einsum("mji,mj->mi", inverse, force))
    assert pressed.sum() > m // 2
    np.testing.assert_allclose(exact[pressed], slope[pressed], atol=1e-8 * np.abs(slope[pressed]).max())
