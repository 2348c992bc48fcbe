"""Draws the figures of docs/theory.md, from the program's own strain measures, integrators and runs.

python scripts/theory_figures.py [FOLDER]          # default: docs/images/theory
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from integrator_tables import ROWS, radius
from pages import DOCS, finished

from pfem_petsc import Case
from pfem_petsc.columns import LOST, STORED, SUPPLIED
from pfem_petsc.contact.projection import project
from pfem_petsc.mechanics.elements import MEASURES

FOLDER = DOCS / "images" / "theory"
# Okabe and Ito's colours, which colour-blind readers tell apart
BLACK, ORANGE, SKY, GREEN = "#222222", "#E69F00", "#56B4E9", "#009E73"
BLUE, RED, PINK = "#0072B2", "#D55E00", "#CC79A7"
STYLE = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 160}


def _save(figure: plt.Figure, folder: Path, name: str) -> Path:
    path = folder / f"{name}.png"
    figure.savefig(path, bbox_inches="tight", facecolor="white", metadata={"Software": None})
    plt.close(figure)
    return path


def bar(folder: Path) -> Path:
    """A bar in the mesh and where its ends have moved, with the forces on its nodes."""
    figure, axes = plt.subplots(figsize=(6.4, 3.0))
    before = np.array([[0.3, 0.3], [2.3, 0.6]])
    after = np.array([[3.2, 0.7], [4.9, 2.3]])
    axes.plot(*before.T, "o-", color=SKY, markersize=7)
    axes.plot(*after.T, "o-", color=BLACK, markersize=7, linewidth=2.5)
    for k, name in enumerate("ab"):
        axes.annotate("", after[k], before[k], arrowprops={"arrowstyle": "->", "color": "0.6", "linestyle": "--"})
        axes.text(*(before[k] + (-0.05, -0.3)), f"$X_{name}$", color=BLUE, ha="center")
        axes.text(*(after[k] + (0.12, -0.25)), f"$x_{name}$")
    n = (after[1] - after[0]) / np.linalg.norm(after[1] - after[0])
    for k, sign, label in ((0, 1.0, "$f_a$"), (1, -1.0, "$f_b$")):
        tip = after[k] - sign * 0.85 * n
        axes.annotate("", tip, after[k], arrowprops={"arrowstyle": "-|>", "color": RED, "linewidth": 2})
        axes.text(*(tip - sign * 0.2 * n), label, color=RED, ha="center", va="center")
    middle = after.mean(axis=0)
    axes.text(*(middle + (-0.55, 0.22)), "$l,\\ N$")
    beside = middle + (0.12, -0.12)
    axes.annotate("", beside + 0.5 * n, beside, arrowprops={"arrowstyle": "->", "color": GREEN})
    axes.text(*(middle + 0.3 * n + (0.32, -0.3)), "$n$", color=GREEN)
    axes.text(*(before.mean(axis=0) + (0.0, 0.18)), "$l_0$", color=BLUE)
    axes.set(xlim=(-0.1, 6.2), ylim=(-0.25, 3.2), aspect="equal")
    axes.axis("off")
    return _save(figure, folder, "bar")


def axial_force(measure: str, stretch: np.ndarray) -> np.ndarray:
    """Return N/(E A) of an elastic bar at stretches l/l0."""
    return np.array([s * slope for s, slope, _ in map(MEASURES[measure], stretch)])


def two_bar_load(measure: str, z: np.ndarray) -> np.ndarray:
    """Return P/(E A) that holds the apex of two bars at heights z; half span 1, at 45 degrees at rest."""
    length = np.sqrt(1.0 + z * z)
    return -2.0 * axial_force(measure, length / np.sqrt(2.0)) * z / length


def strain(folder: Path) -> Path:
    """Axial force over stretch, and the path of the two-bar truss, for the three strain measures."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.3), layout="constrained")
    stretch = np.linspace(0.25, 2.0, 300)
    z = np.linspace(-1.25, 1.25, 400)
    lines = {"engineering": (BLUE, "-"), "green": (RED, "--"), "logarithmic": (GREEN, "-.")}
    for name, (colour, line) in lines.items():
        left.plot(stretch, axial_force(name, stretch), line, color=colour, label=name)
        right.plot(1.0 - z, two_bar_load(name, z), line, color=colour, label=name)
    left.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    left.set(xlabel="stretch $l/l_0$", ylabel="$N/(EA)$", ylim=(-1.6, 1.6))
    right.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    right.set(xlabel="displacement of the apex / half span", ylabel="$P/(EA)$", title="two bars at 45°")
    left.legend(frameon=False)
    return _save(figure, folder, "strain_measures")


def integrators(folder: Path) -> Path:
    """Spectral radius of the schemes over omega h."""
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    chosen = {
        "`central_differences`": (BLACK, "-"),
        "`chung_lee`, β = 28/27": (ORANGE, "-"),
        "`newmark`, β = 1, γ = 3/2 (Hu)": (RED, "-"),
        "`newmark`, β = 1/4, γ = 1/2": (SKY, "-"),
        "`houbolt`": (GREEN, "--"),
        "`wilson`, θ = 1.4": (PINK, "--"),
        "`generalized_alpha`, ρ∞ = 0.8": (BLUE, "-."),
    }
    for row in ROWS:
        if row.label not in chosen:
            continue
        colour, line = chosen[row.label]
        omega = np.geomspace(0.05, 100.0, 240)
        values = np.array([radius(row, each) for each in omega])
        values[values > 1.0 + 1e-6] = np.nan
        wide = 4.0 if colour == BLACK else 1.8
        axes.semilogx(omega, values, line, color=colour, linewidth=wide, label=row.label.replace("`", ""))
    axes.set(xlabel="$\\Omega = \\omega h$", ylabel="spectral radius", ylim=(0.0, 1.05), xlim=(0.05, 100.0))
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    return _save(figure, folder, "spectral_radius")


def nearest(point: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the program's projection of a point of the plane on walls through the origin."""
    x = np.array([[*point, 0.0]])
    planes = np.zeros((1, len(normals), 3))
    planes[0, :, :2] = normals
    zero = np.zeros((1, len(normals)))
    assert project(x, np.zeros((1, 3), dtype=bool), planes, zero, 1e-13, zero.copy()) == -1
    return x[0, :2]


def contact(folder: Path) -> Path:
    """The nearest admissible point between two oblique walls, and what clamping one after the other gives."""
    figure, axes = plt.subplots(figsize=(5.6, 3.0), layout="constrained")
    angles = np.radians([90.0, 235.0])
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    for n in normals:
        axes.plot(*np.array([[-3.0, 3.0]] * 2) * np.array([[-n[1]], [n[0]]]), color="0.35")
    corner = np.array([[0.0, 0.0], [-4.0, 0.0], 4.0 * np.array([-np.cos(np.radians(35.0)), np.sin(np.radians(35.0))])])
    axes.fill(*corner.T, color=SKY, alpha=0.25, linewidth=0.0)
    axes.text(-2.1, 0.45, "where nodes may be", color=BLUE)
    point = np.array([0.9, -0.35])
    best = nearest(point, normals)
    clamped = point.copy()
    for n in normals:
        clamped = clamped - min(0.0, n @ clamped) * n
    axes.plot(*point, "o", color=BLACK, markersize=8)
    axes.text(*(point + (0.1, -0.12)), "$\\hat{x}$, without contact")
    for end, colour, text, shift in (
        (best, GREEN, "nearest point", (-0.15, -0.24)),
        (clamped, RED, "one wall after the other", (-0.1, -0.25)),
    ):
        axes.annotate("", end, point, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.6})
        axes.plot(*end, "s", color=colour, markersize=7)
        axes.text(*(end + shift), text, color=colour, ha="right" if shift[0] < 0 else "left")
    axes.set(xlim=(-2.2, 2.6), ylim=(-1.2, 1.2), aspect="equal")
    axes.axis("off")
    return _save(figure, folder, "contact")


def energies(folder: Path) -> Path:
    """Energies of a smaller lattice_drop over time, stacked; their sum is constant."""
    smaller = ["mesh.cells=[6, 6, 6]", "node_set.top.nearest=[0.06, 0.06, 0.06]", "time.end=1.5e-4", "output.fields=[]"]
    with finished(Case.load("lattice_drop", smaller)) as result:
        history = result.history
        time = 1e6 * history["time"]
        columns = {name: np.array(history[name]) for name in (*STORED, *LOST, *SUPPLIED)}
    total = columns["kinetic_energy"][0]
    columns["impact, and scheme"] = columns.pop("impact_dissipation") + columns.pop("numerical_dissipation")
    lost = [*(name for name in LOST if name in columns), "impact, and scheme"]
    shown = [name for name in (*STORED, *lost) if np.abs(columns[name]).max() > 2e-3 * total]
    figure, axes = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
    colours = dict(zip(shown, (BLUE, GREEN, ORANGE, PINK, SKY, RED)))
    labels = [name.replace("_", " ") for name in shown]
    axes.stackplot(time, [columns[name] / total for name in shown], colors=colours.values(), labels=labels)
    axes.axhline(1.0, color=BLACK, linewidth=1.0, linestyle="--")
    axes.set(xlabel="time [µs]", ylabel="energy / kinetic energy at the start", xlim=(0.0, time[-1]), ylim=(0.0, 1.08))
    axes.legend(frameon=True, framealpha=0.9, fontsize=8, loc="lower right")
    return _save(figure, folder, "energies")


def main(folder: Path) -> list[Path]:
    """Draw all figures into a folder and return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        return [draw(folder) for draw in (bar, strain, integrators, contact, energies)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    for path in main(parser.parse_args().folder):
        print(path)
