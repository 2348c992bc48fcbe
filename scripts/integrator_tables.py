"""Tables of docs/integrators.md, computed with the schemes themselves on linear oscillators and a spinning bar.

usage: python scripts/integrator_tables.py [--check]
Rewrites the text between <!-- table NAME --> and <!-- end --> in docs/integrators.md; with --check it changes
nothing and fails if the file is not up to date.
"""

from __future__ import annotations

import argparse
import sys
from typing import NamedTuple

import numpy as np
from pages import DOCS, finished, markdown

from pfem_petsc.integrators.base import Scheme, State
from pfem_petsc.registry import lookup

DOCUMENT = DOCS / "integrators.md"
SHARES = (0.05, 0.1, 0.2)  # h/T
MEMORY = {
    "central_differences": ("half_velocity",),
    "houbolt": ("d0", "d1"),
    "noh_bathe": ("half_velocity", "first_known"),
}


class Row(NamedTuple):
    """A line of the tables."""

    label: str
    integrator: str
    parameters: dict[str, float]


ROWS = (
    Row("`central_differences`", "central_differences", {}),
    Row("`chung_lee`, β = 1", "chung_lee", {"beta": 1.0}),
    Row("`chung_lee`, β = 28/27", "chung_lee", {"beta": 28.0 / 27.0}),
    Row("`hulbert_chung`, ρ_b = 0", "hulbert_chung", {"rho_b": 0.0}),
    Row("`souza_moura` (stand-in: `hulbert_chung`, ρ_b = 0.3)", "souza_moura", {}),
    Row("`hulbert_chung`, ρ_b = 0.8", "hulbert_chung", {"rho_b": 0.8}),
    Row("`noh_bathe`, p = 0.54 (two balances a step)", "noh_bathe", {"p": 0.54}),
    Row("`noh_bathe`, p = 0.7 (two balances a step)", "noh_bathe", {"p": 0.7}),
    Row("`newmark`, β = 1, γ = 3/2 (Hu)", "newmark", {"beta": 1.0, "gamma": 1.5}),
    Row("`newmark`, β = 1/4, γ = 1/2", "newmark", {"beta": 0.25, "gamma": 0.5}),
    Row("`houbolt`", "houbolt", {}),
    Row("`wilson`, θ = 1.4", "wilson", {"theta": 1.4}),
    Row("`wilson`, θ = 1.5", "wilson", {"theta": 1.5}),
    Row("`generalized_alpha`, ρ∞ = 0.8", "generalized_alpha", {"rho_inf": 0.8}),
    Row("`generalized_alpha`, ρ∞ = 0", "generalized_alpha", {"rho_inf": 0.0}),
    Row("`hht_alpha`, α = −0.05", "hht_alpha", {"alpha": -0.05}),
    Row("`hht_alpha`, α = −1/3", "hht_alpha", {"alpha": -1.0 / 3.0}),
    Row("`bathe`, ρ∞ = 0.8 (two balances a step)", "bathe", {"rho_inf": 0.8}),
    Row("`bathe`, ρ∞ = 0 (two balances a step)", "bathe", {"rho_inf": 0.0}),
    Row("`energy_momentum`", "energy_momentum", {}),
)


def make(row: Row) -> Scheme:
    """Return the scheme of a line."""
    module = lookup("pfem_petsc.integrators", row.integrator, "table")
    return module.Scheme(module.Parameters(**row.parameters))


def advance(scheme: Scheme, state: State, h: float, held: bool) -> None:
    """Make one step of a unit mass on a unit spring (omega = 1), or of a node fixed at x = 0, in place.

    The balance is solved as in the program: M a + (1 - w) f(x0) + w f(x) = 0, or x = 0.
    """
    for share, _ in scheme.substeps:
        _advance(scheme, state, share * h, held)


def _advance(scheme: Scheme, state: State, h: float, held: bool) -> None:
    """Make a substep."""
    if scheme.solves_next_position:
        scheme.advance(state, h)
    balance = scheme.balance(state, h)
    known = 0.0 if balance.a_hat is None else float(balance.a_hat[0, 0])
    predictor, x0 = float(balance.predictor[0, 0]), float(state.x[0, 0])
    if held:
        u = -predictor
    elif balance.discrete_gradient:  # the discrete gradient of a quadratic energy: the force at the middle
        u = -(known + 0.5 * (x0 + predictor)) / (balance.alpha + 0.5)
    else:
        weight = balance.weight
        u = -(known + weight * predictor + (1.0 - weight) * x0) / (balance.alpha + weight)
    scheme.finish(state, balance, np.full((1, 3), u), h)


def amplification(row: Row, h: float, held: bool = False) -> np.ndarray:
    """Return the matrix of one step on (x, v h, a h^2) and the scheme's memory, column by column from unit states."""
    names = MEMORY.get(row.integrator, ())
    size = 3 + len(names)
    scales = np.array([1.0, 1.0 / h, 1.0 / h**2] + [1.0 / h if name == "half_velocity" else 1.0 for name in names])
    columns = []
    for unit in np.eye(size) * scales:
        arrays = [np.full((1, 3), value) for value in unit]
        zero = np.zeros((1, 3))
        state = State(arrays[0], arrays[1], arrays[2], zero, zero, zero, zero)
        state.memory = dict(zip(names, arrays[3:]))
        advance(make(row), state, h, held)
        after = [state.x, state.v, state.a, *(state.memory[name] for name in names)]
        columns.append(np.array([part[0, 0] for part in after]) / scales)
    return np.array(columns).T


def radius(row: Row, h: float, held: bool = False) -> float:
    """Return the spectral radius of a step; for an oscillator without the root 1 that no initial state excites."""
    return float(np.abs(np.linalg.eigvals(amplification(row, h, held))).max())


def principal(row: Row, h: float) -> complex:
    """Return the eigenvalue that approximates exp(i omega h)."""
    values = np.linalg.eigvals(amplification(row, h))
    return complex(values[np.argmin(np.abs(values - np.exp(1j * h)))])


def damping_and_period(row: Row, share: float) -> tuple[float, float]:
    """Return the algorithmic damping ratio, and the relative error of the period, at h/T."""
    omega = 2.0 * np.pi * share
    value = principal(row, omega)
    angle = abs(np.angle(value))
    return float(-np.log(abs(value)) / angle), float(omega / angle - 1.0)


def order(row: Row) -> int:
    """Return the order of the principal eigenvalue, whose local error decreases with h^(order + 1)."""
    errors = [abs(principal(row, h) - np.exp(1j * h)) for h in (0.02, 0.01)]
    return round(np.log2(errors[0] / errors[1])) - 1


def limit(row: Row) -> float:
    """Return the largest stable omega h by bisection; infinite if 10^4 is stable."""
    stable = lambda h: radius(row, h) <= 1.0 + 1e-6  # noqa: E731 - double roots on the circle are off by 1e-8
    if stable(1e4):
        return np.inf
    low, high = 0.5, 4.0
    while high - low > 1e-5:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def accuracy_table() -> str:
    """Return the table of order, limit, high frequencies, damping ratio and period error."""
    rows = []
    for row in ROWS:
        bound = limit(row)
        ends = f"{radius(row, 1e4):.3f}" if np.isinf(bound) else f"{radius(row, bound):.3f} at the limit"
        cells = []
        for share in SHARES:
            damping, period = damping_and_period(row, share)
            cells.append(f"{damping + 0.0:.4f}, {100 * period:+.2f} %".replace("-0.0000", "0.0000"))
        rows.append([row.label, str(order(row)), "∞" if np.isinf(bound) else f"{bound:.4f}", ends, *cells])
    head = ["scheme", "order", "limit Ω", "ρ(∞)", *(f"h/T = {share:g}: ξ, period" for share in SHARES)]
    return markdown(head, rows)


def held_table() -> str:
    """Return the table of velocities of a node that flies at v and is then fixed at a wall that it has just reached."""
    rows = []
    for row in ROWS:
        scheme, h = make(row), 1.0
        names = MEMORY.get(row.integrator, ())
        one, zero = np.ones((1, 3)), np.zeros((1, 3))
        state = State(zero.copy(), one.copy(), zero.copy(), zero, zero, zero, zero)
        state.memory = {name: one.copy() for name in names}
        shown = []
        if scheme.solves_next_position:  # the position follows from the previous velocity and is at the wall already
            state.x = -one
        for _ in range(6):
            advance(scheme, state, h, held=True)
            shown.append(f"{state.v[0, 0] + 0.0:.3f}".replace("-0.000", "0.000"))
        matrix = amplification(row, h, held=True)
        size = np.abs(np.linalg.eigvals(matrix)).max()
        # a nilpotent matrix has eigenvalues of the size of rounding to a fraction of a power
        nilpotent = np.abs(np.linalg.matrix_power(matrix, len(matrix) + 1)).max() < 1e-12
        rows.append([row.label, "0" if nilpotent else f"{size:.3f}", *shown])
    return markdown(["scheme", "ρ held", *(f"step {n}" for n in range(1, 7))], rows)


def spin_table() -> str:
    """Return the table of remaining angular momentum and energy of a free bar after five turns of 100 steps each."""
    from pfem_petsc import Case

    stretch, h = 4e-3, 2.0 * np.pi / 100  # rho omega^2 l^2/(4 E), which also sets the bar's own frequency; omega = 1
    rows = []
    for row in ROWS:
        case = Case.from_dict(
            {
                "title": "Spinning bar",
                "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
                "material": {"it": {"young_modulus": 0.25 / stretch, "density": 1.0}},
                "section": {"it": {"area": 1.0, "material": "it"}},
                "initial": {"angular_velocity": [0.0, 0.0, 1.0]},
                "time": {"integrator": row.integrator, "step": h, "end": 500 * h, **row.parameters},
                "output": {"fields_every": 0},
                "solver": {"rtol": 1e-12},
            }
        )
        with finished(case) as result:
            history = result.history
            spin = history["angular_momentum"][-1, 2] / history["angular_momentum"][0, 2]
            energy = history["kinetic_energy"] + history["elastic_energy"]
        rows.append([row.label, f"{spin:.4f}", f"{energy[-1] / energy[0]:.3f}"])
    return markdown(["scheme", "angular momentum left", "energy left"], rows)


def damped_errors(row: Row, damping: str, steps: int) -> tuple[float, float]:
    """Return the largest errors of position and reaction, over amplitudes, of a bar with the damping ratio 0.2.

    One node of unit mass, and one held, on a unit bar; the free node starts at 0.1 m/s and moves for 4 s.
    """
    from pfem_petsc import Case

    ratio, speed, end = 0.2, 0.1, 4.0
    material = {"young_modulus": 1.0, "density": 2.0}
    material |= {"mass": {"damping": 4.0 * ratio}, "bars": {"stiffness_damping": 2.0 * ratio}}.get(damping, {})
    nodes = {"held": {"group": "start"}, "free": {"group": "end"}}
    case = {
        "title": "Damped oscillator",
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "node_set": nodes,
        "material": {"it": material},
        "section": {"it": {"area": 1.0, "material": "it"}},
        "support": [{"node_set": "held", "fix": "xyz"}, {"node_set": "free", "fix": "yz"}],
        "initial": {"on": [{"node_set": "free", "velocity": [speed, 0.0, 0.0]}]},
        "time": {"integrator": row.integrator, "step": end / steps, "end": end, **row.parameters},
        "output": {"fields_every": 0, "probe": [{"name": name, "node_set": name} for name in nodes]},
        "solver": {"rtol": 1e-13},
    }
    if damping == "dashpot":
        case["dashpot"] = [{"between": ["held", "free"], "coefficient": 2.0 * ratio}]
    with finished(Case.from_dict(case)) as result:
        history = result.history
        t, x = history["time"], history["probe/free/position"][:, 0, 0] - 1.0
        reaction = history["probe/held/reaction"][:, 0, 0]
    fast = np.sqrt(1.0 - ratio**2)
    decay = speed * np.exp(-ratio * t)
    exact = decay / fast * np.sin(fast * t)
    rate = decay * (np.cos(fast * t) - ratio / fast * np.sin(fast * t))
    force = -exact - (0.0 if damping == "mass" else 2.0 * ratio * rate)
    return float(np.abs(x - exact).max()) / speed, float(np.abs(reaction - force).max()) / speed


def damped_table() -> str:
    """Return the table of errors and orders with damping by mass, by stiffness and by a dashpot, and of reactions."""
    rows = []
    for row in ROWS:
        errors = {of: [damped_errors(row, of, steps) for steps in (50, 100)] for of in ("mass", "bars", "dashpot")}
        shown = [(errors[of][0][0], errors[of][1][0]) for of in errors]
        shown += [(errors[of][0][1], errors[of][1][1]) for of in ("mass", "bars")]
        rows.append([row.label, *(f"{fine:.1e}, {np.log2(coarse / fine):.2f}" for coarse, fine in shown)])
    positions = ("`damping`", "`stiffness_damping`", "`dashpot`")
    return markdown(["scheme", *positions, "reaction, `damping`", "reaction, `stiffness_damping`"], rows)


TABLES = {"accuracy": accuracy_table, "damped": damped_table, "held": held_table, "spin": spin_table}


def main() -> None:
    """Write or check the document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing; status 1 where the tables are old")
    check = parser.parse_args().check
    text = old = DOCUMENT.read_text(encoding="utf-8")
    for name, table in TABLES.items():
        start = f"<!-- table {name} -->\n"
        end = text[text.index("<!-- end -->", text.index(start)) :]
        text = text[: text.index(start)] + start + "\n" + table() + "\n\n" + end
    if check:
        sys.exit(text != old)
    DOCUMENT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
