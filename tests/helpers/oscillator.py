"""The linear oscillator as a model of the program, a record of the ground, and exact responses."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.registry import lookup
from pfem_petsc.stepping.explicit import ExplicitStepper
from pfem_petsc.stepping.implicit import ImplicitStepper
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan

YOUNG, DENSITY, LENGTH = 2.0, 1.0, 1.0
OMEGA = {"lumped": np.sqrt(2 * YOUNG / DENSITY) / LENGTH, "consistent": np.sqrt(3 * YOUNG / DENSITY) / LENGTH}


def case(integrator, parameters=None, mass="lumped", damping_ratio=0.0, h=1e-3, end=1.0, velocity=0.0):
    """The oscillator with a step h [s]; the free node starts at rest length, with a velocity [m/s]."""
    damping = 2.0 * damping_ratio * OMEGA[mass] * DENSITY
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": LENGTH, "elements": 1},
            "node_set": {"base": {"nearest": [0.0, 0.0, 0.0]}, "mass": {"nearest": [LENGTH, 0.0, 0.0]}},
            "material": {"it": {"young_modulus": YOUNG, "density": DENSITY, "damping": damping}},
            "section": {"it": {"area": 1.0, "material": "it"}},
            "initial": {"on": [{"node_set": "mass", "velocity": [velocity, 0.0, 0.0]}]},
            "support": [{"node_set": "base", "fix": "xyz"}, {"node_set": "mass", "fix": "yz"}],
            "time": {"integrator": integrator, "step": h, "end": end, "mass": mass, **(parameters or {})},
            "solver": {"rtol": 1e-14},
            "output": {"probe": [{"name": "mass", "node_set": "mass"}]},
        }
    )


def stepper(omega_h, integrator, parameters=None, mass="lumped", damping_ratio=0.0, x0=0.0, v0=0.0):
    """A started stepper at Omega = omega h, also above the limit at which the program refuses to start.

    ``x0`` [m] and ``v0`` [m/s] are those of the free node.
    """
    the_case = case(integrator, parameters, mass, damping_ratio)
    model = Model(the_case, MPI.COMM_SELF)
    scheme = lookup("pfem_petsc.integrators", integrator, "test").Scheme(the_case.time.scheme)
    h = omega_h / OMEGA[mass]
    if scheme.explicit and mass == "lumped":
        it = ExplicitStepper(model, scheme, h)
    else:
        it = ImplicitStepper(model, scheme, h, make_plan(Model(case("newmark", mass=mass), MPI.COMM_SELF)).linear)
    free = int(np.flatnonzero(model.mesh.node_ids == 1)[0])
    it.state.position[free, 0] += x0
    model.initial_velocity = lambda: v0 * np.outer(np.arange(2) == free, [1.0, 0.0, 0.0])
    it.start()
    it.free = free
    return it


def displacements(it, steps):
    """(steps + 1,) displacement of the free node from the bar's rest length; fewer where it runs away."""
    found = [it.state.position[it.free, 0] - LENGTH]
    for _ in range(steps):
        it.step()
        found.append(it.state.position[it.free, 0] - LENGTH)
        if not abs(found[-1]) < 1e-2 * LENGTH:
            break
    return np.array(found)


def roots(d, order):
    """Roots of the recurrence of an order that a sequence follows: the scheme's eigenvalues, by least squares."""
    d = d / np.abs(d).max()
    delayed = np.stack([d[k : len(d) - order + k] for k in range(order)], axis=1)
    coefficients = np.linalg.lstsq(delayed, d[order:], rcond=None)[0]
    return np.roots([1.0, *-coefficients[::-1]])


def properties(eigenvalues, omega_h):
    """Spectral radius, algorithmic damping ratio and period error (T' - T)/T of the principal pair."""
    principal = max((z for z in eigenvalues if z.imag > 1e-9), key=abs)
    angle = np.angle(principal)
    return np.abs(eigenvalues).max(), -np.log(abs(principal)) / angle, omega_h / angle - 1.0


def newmark_family(beta, gamma, alpha_m=0.0, alpha_f=0.0, lagged_velocity=False):
    """Eigenvalues of (1-a_m) a1 + a_m a0 + 2 xi w v + w^2 x = 0 with v, x weighted (1-a_f) new + a_f old."""

    def eigenvalues(omega_h, damping_ratio=0.0):
        w2, c = omega_h**2, 2.0 * damping_ratio * omega_h
        v1, v0 = (0.0, 1.0) if lagged_velocity else (1.0 - alpha_f, alpha_f)
        # rows: balance, position, velocity; columns: x, h v, h^2 a
        new = np.array([[(1 - alpha_f) * w2, v1 * c, 1 - alpha_m], [1, 0, -beta], [0, 1, -gamma]])
        old = np.array([[-alpha_f * w2, -v0 * c, -alpha_m], [1, 1, 0.5 - beta], [0, 1, 1 - gamma]])
        return np.linalg.eigvals(np.linalg.solve(new, old))

    return eigenvalues


def explicit_alpha(rho):
    a_m = (2 * rho - 1) / (1 + rho)
    beta = (5 - 3 * rho) / ((1 + rho) ** 2 * (2 - rho))
    return newmark_family(beta, 1.5 - a_m, a_m, 1.0, lagged_velocity=True)


def implicit_alpha(rho):
    a_m, a_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    return newmark_family((1 - a_m + a_f) ** 2 / 4, 0.5 - a_m + a_f, a_m, a_f)


def hht_alpha(alpha):
    return newmark_family((1 - alpha) ** 2 / 4, 0.5 - alpha, 0.0, -alpha)


def bathe(rho):
    """Two substeps of matrices on (x, h v, h^2 a), with the whole step h."""

    def eigenvalues(omega_h, damping_ratio=0.0):
        g = 0.5 if rho == 1.0 else (2.0 - np.sqrt(2.0 + 2.0 * rho)) / (1.0 - rho)
        q1 = (rho + 1.0) / (2.0 * g * (rho - 1.0) + 4.0)
        q2 = 0.5 - g * q1
        q0 = 1.0 - q1 - q2
        c, k, one = 2.0 * damping_ratio * omega_h, omega_h**2, np.eye(3)
        # unknown (x, v, a) of each substep: two formulas and the balance
        left = np.array([[1.0, -0.5 * g, 0.0], [0.0, 1.0, -0.5 * g], [k, c, 1.0]])
        middle = np.linalg.solve(left, [[1.0, 0.5 * g, 0.0], [0.0, 1.0, 0.5 * g], [0.0, 0.0, 0.0]])
        left = np.array([[1.0, -q2, 0.0], [0.0, 1.0, -q2], [k, c, 1.0]])
        start = np.array([[0.0, q0, 0.0], [0.0, 0.0, q0], [0.0, 0.0, 0.0]]) + np.diag([1.0, 1.0, 0.0])
        between = np.array([[0.0, q1, 0.0], [0.0, 0.0, q1], [0.0, 0.0, 0.0]])
        return np.linalg.eigvals(np.linalg.solve(left, start @ one + between @ middle))

    return eigenvalues


def noh_bathe(p):
    """Two explicit substeps of rows on (x, h v, h^2 a), with the whole step h and velocities in the balances."""

    def eigenvalues(omega_h, damping_ratio=0.0):
        s, c, k = 1.0 - p, 2.0 * damping_ratio * omega_h, omega_h**2
        q1 = (1.0 - 2.0 * p) / (2.0 * p * s)
        q2 = 0.5 - p * q1
        q0 = 0.5 - q1 - q2
        x, v, a = np.eye(3)
        middle = x + p * v + 0.5 * p * p * a
        known = v + 0.5 * p * a
        a_middle = -(k * middle + c * known) / (1.0 + 0.5 * p * c)
        v_middle = known + 0.5 * p * a_middle
        x1 = middle + s * v_middle + 0.5 * s * s * a_middle
        known = v_middle + s * (q0 * a + (0.5 + q1) * a_middle)
        a1 = -(k * x1 + c * known) / (1.0 + s * q2 * c)
        return np.linalg.eigvals(np.array([x1, known + s * q2 * a1, a1]))

    return eigenvalues


def chung_lee(beta):
    return newmark_family(beta, 1.5, 0.0, 1.0, lagged_velocity=True)


def central_differences(omega_h, damping_ratio=0.0):
    c = damping_ratio * omega_h
    return np.roots([1 + c, omega_h**2 - 2, 1 - c])


def houbolt(omega_h, damping_ratio=0.0):
    c = damping_ratio * omega_h / 3
    return np.roots([2 + omega_h**2 + 11 * c, -5 - 18 * c, 4 + 9 * c, -1 - 2 * c])


def wilson(theta):
    def eigenvalues(omega_h, damping_ratio=0.0):
        # linear acceleration over theta h: x_t, h v_t as rows over (x, h v, h^2 a0, h^2 a1)
        t = theta
        x_t = np.array([1, t, t**2 / 2 - t**3 / 6, t**3 / 6])
        v_t = np.array([0, 1, t - t**2 / 2, t**2 / 2])
        a_t = np.array([0, 0, 1 - t, t])
        balance = a_t + 2 * damping_ratio * omega_h * v_t + omega_h**2 * x_t
        a1 = -balance[:3] / balance[3]
        x1 = np.array([1, 1, 1 / 3, 0])[:3] + a1 / 6
        v1 = np.array([0, 1, 0.5]) + a1 / 2
        return np.linalg.eigvals(np.array([x1, v1, a1]))

    return eigenvalues


# name in messages: integrator, its parameters, order of the position recurrence, amplification
SCHEMES = {
    "central_differences": ("central_differences", {}, 2, central_differences),
    "chung_lee 1": ("chung_lee", {"beta": 1.0}, 3, chung_lee(1.0)),
    "chung_lee 1.02": ("chung_lee", {"beta": 1.02}, 3, chung_lee(1.02)),
    "chung_lee 28/27": ("chung_lee", {}, 3, chung_lee(28 / 27)),
    "hulbert_chung 0": ("hulbert_chung", {"rho_b": 0.0}, 3, explicit_alpha(0.0)),
    "hulbert_chung 0.8": ("hulbert_chung", {}, 3, explicit_alpha(0.8)),
    "hulbert_chung 1": ("hulbert_chung", {"rho_b": 1.0}, 3, explicit_alpha(1.0)),
    "souza_moura": ("souza_moura", {}, 3, explicit_alpha(0.3)),
    "noh_bathe 0.54": ("noh_bathe", {}, 2, noh_bathe(0.54)),
    "noh_bathe 0.7": ("noh_bathe", {"p": 0.7}, 2, noh_bathe(0.7)),
    "newmark": ("newmark", {}, 2, newmark_family(1.0, 1.5)),
    "trapezoid": ("newmark", {"beta": 0.25, "gamma": 0.5}, 2, newmark_family(0.25, 0.5)),
    "houbolt": ("houbolt", {}, 3, houbolt),
    "wilson 1.4": ("wilson", {}, 3, wilson(1.4)),
    "wilson 1.5": ("wilson", {"theta": 1.5}, 3, wilson(1.5)),
    "wilson 2": ("wilson", {"theta": 2.0}, 3, wilson(2.0)),
    "generalized_alpha 0.8": ("generalized_alpha", {}, 3, implicit_alpha(0.8)),
    "generalized_alpha 0": ("generalized_alpha", {"rho_inf": 0.0}, 3, implicit_alpha(0.0)),
    "bathe 0": ("bathe", {}, 2, bathe(0.0)),
    "bathe 0.8": ("bathe", {"rho_inf": 0.8}, 2, bathe(0.8)),
    "bathe 1": ("bathe", {"rho_inf": 1.0}, 2, bathe(1.0)),
    "hht_alpha -0.05": ("hht_alpha", {}, 3, hht_alpha(-0.05)),
    "hht_alpha -1/3": ("hht_alpha", {"alpha": -1.0 / 3.0}, 3, hht_alpha(-1.0 / 3.0)),
}


TIMES = 0.02 * np.arange(76)


def ground(t):
    """Displacement, velocity and acceleration of the ground: a product of slow sines, at rest at the start."""
    a, b = 2.0 * np.pi / 3.0, 2.0 * np.pi * 3.0
    s, c, p, q = np.sin(a * t), np.cos(a * t), np.sin(b * t), np.cos(b * t)
    e, e1, e2 = s**2, 2 * a * s * c, 2 * a * a * (c**2 - s**2)
    return 0.02 * e * p, 0.02 * (e1 * p + e * b * q), 0.02 * (e2 * p + 2 * e1 * b * q - e * b * b * p)


def response(times, values, at, w):
    """Relative displacement of an oscillator under accelerations of its base, linear between rows: exact pieces."""
    found = np.zeros(len(at))
    y, v = 0.0, 0.0
    for t0, t1, a0, a1 in zip(times[:-1], times[1:], -values[:-1], -values[1:]):
        k = (a1 - a0) / (t1 - t0)
        # a particular solution (a0 + k s)/w^2, and what is left as free vibration
        p, q = y - a0 / w**2, (v - k / w**2) / w
        inside = (at >= t0 - 1e-9) & (at <= t1 + 1e-9)
        s = np.append(at[inside] - t0, t1 - t0)
        moved = (a0 + k * s) / w**2 + p * np.cos(w * s) + q * np.sin(w * s)
        found[inside], y = moved[:-1], moved[-1]
        v = k / w**2 + w * (q * np.cos(w * s[-1]) - p * np.sin(w * s[-1]))
    return found


def modal_response(model, stiffness, times, values, at):
    """Displacements (times, nodes, 3) of a truss with equal bars of EA = ``stiffness`` [N] relative to its supports,
    under accelerations of the ground along x; and its lowest circular frequency. Small displacements."""
    points, bars, mass = model.mesh.points, model.mesh.bars, model.inertia.mass
    matrix = np.zeros((3 * len(points), 3 * len(points)))
    for a, b in bars:
        way = points[b] - points[a]
        block = stiffness / np.linalg.norm(way) ** 3 * np.outer(way, way)
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            matrix[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += sign * block
    free = np.flatnonzero(~model.supports.fixed.ravel())
    root = np.sqrt(np.repeat(mass, 3))[free]
    squares, shapes = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(root, root))
    push = root * (free % 3 == 0)
    shaken = [response(times, values, at, np.sqrt(square)) for square in squares]
    moved = np.zeros((len(at), 3 * len(points)))
    moved[:, free] = ((shapes.T @ push)[:, None] * np.array(shaken)).T @ shapes.T / root
    return moved.reshape(len(at), -1, 3), np.sqrt(squares[0])
