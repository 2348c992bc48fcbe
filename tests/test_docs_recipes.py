"""The recipes of docs/recipes.md run as they stand there, and give the figures of the page, beside those by hand."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.launch import environment
from helpers.pages import DOCS, ROOT

from pfem_petsc import open_result
from pfem_petsc.cli.main import main

PAGE = (DOCS / "recipes.md").read_text()
RECIPES = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, flags=re.MULTILINE | re.DOTALL))
BLOCK = re.compile(r"^```(toml|python|bash)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)


@pytest.fixture
def cook(tmp_path, monkeypatch, capfd, own_registry):
    """Run a recipe in an empty folder that has the meshes of the checkout, and return what it prints."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pfem_petsc").mkdir()
    for folder in ("meshes", "pfem_petsc/cases"):
        (tmp_path / folder).symlink_to(ROOT / folder)

    def run(name: str) -> str:
        for language, text in BLOCK.findall(RECIPES[name]):
            file = re.match(r"# (\S+\.\w+)\n", text)
            if file:
                Path(file[1]).write_text(text)
            elif language == "python":
                exec(compile(text, name, "exec"), {})  # noqa: S102 - the text of our own page
            elif text.startswith("#!"):
                submit(text)
            else:
                for line in text.replace("\\\n", " ").splitlines():
                    words = shlex.split(line, comments=True)
                    if words[:3] == ["python", "-m", "pfem_petsc"]:
                        assert main(words[3:]) == 0, (line, capfd.readouterr().err)
                    else:
                        subprocess.run(words, check=True)
        return capfd.readouterr().out

    return run


def submit(text: str) -> None:
    """Run a job script with this machine's Python, in an environment that is there."""
    folder = Path(".venv/bin")
    folder.mkdir(parents=True)
    (folder / "activate").write_text(f'export PATH="{folder.resolve()}:$PATH"\n')
    (folder / "python").write_text(f'#!/bin/bash\nexec "{sys.executable}" "$@"\n')
    (folder / "python").chmod(0o755)
    Path("job.sh").write_text(text.replace("--processes 32", "--processes 2"))
    variables = {**environment(), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-e", "job.sh"], env=variables, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def shown(name: str) -> dict[str, tuple[float, float]]:
    """The figures of a recipe: what the program gives, and by hand, where the last equation has a number."""
    rows = re.findall(r"^\| ([^|]+) \| ([\d.]+) \| ([^|]+) \|$", RECIPES[name], flags=re.MULTILINE)
    found = {}
    for figure, value, hand in rows:
        number = re.search(r"[=:] ([\d.]+)\b(?!.*[=:] [\d.])", hand)
        found[figure] = (float(value), float(number[1]) if number else np.nan)
    return found


def same(quoted: float, value: float, text: str) -> bool:
    """Whether a number is the quoted one as it is rounded on the page."""
    digits = re.search(rf"\| {re.escape(text)} \| (?:\d+\.?)(\d*)", PAGE)[1]
    return abs(quoted - value) <= 0.501 * 10.0 ** -len(digits)


def compare(name: str, values: list[float], by_hand: list[float], close: list[float]) -> None:
    """Compare the program's figures and independent ones with those of the page, and with each other."""
    figures = shown(name)
    assert len(figures) == len(values) == len(by_hand) == len(close)
    for (text, (quoted, hand)), value, own, tolerance in zip(figures.items(), values, by_hand, close, strict=True):
        assert same(quoted, value, text), (text, value)
        assert np.isnan(hand) or hand == pytest.approx(own, rel=5e-3), (text, own)
        assert value == pytest.approx(own, rel=tolerance), text


def numbers(printed: str, *names: str) -> list[float]:
    return [
        float(re.search(rf"^ *{name}(?: [a-z]+)? +(-?[\d.e+-]+)", printed, flags=re.MULTILINE)[1]) for name in names
    ]


def test_every_recipe_is_listed_and_has_figures():
    listed = re.findall(r"^\| \[[^]]+\]\(#([\w-]+)\)", PAGE, flags=re.MULTILINE)
    assert listed == [name.lower().replace(" ", "-") for name in RECIPES] and len(RECIPES) == 8
    assert all(shown(name) for name in RECIPES)
    for name, text in RECIPES.items():
        cases = [block for _, block in BLOCK.findall(text) if ".toml\n" in block.split("\n", 1)[0] + "\n"]
        assert all(len(block.strip().splitlines()) <= 28 for block in cases), name


@pytest.mark.slow
def test_tower(cook):
    """The tower is cut above its feet; area and second moment are those of a thin tube."""
    printed = cook("Tower with load cases")
    row = re.search(r"legs +1 +-([\d.]+) +\S+ +([\d.]+) +([\d.]+) +ULS", printed)
    force, strength, buckling = (float(number) for number in row.groups())
    area = np.pi * (0.06**2 - 0.054**2) / 4.0
    second = np.pi * (0.06**4 - 0.054**4) / 64.0
    hand = [63.0, force / (area * 235e6), force / (np.pi**2 * 2.1e11 * second)]
    compare("Tower with load cases", [force / 1e3, strength, buckling], hand, [0.07, 1e-3, 1e-3])
    support = open_result("results/tower").history["support_force"][-1]
    assert support == pytest.approx([-1.5 * 8e3, 0.0, 1.35 * 80e3], abs=1e-3)
    assert all(Path(file).stat().st_size > 500 for file in ("members.png", "members.csv", "results/tower/report.html"))


@pytest.mark.slow
def test_net(cook):
    printed = cook("Cable net")
    values = numbers(printed, "height", "force over length", "lift of supports")
    compare("Cable net", values, [1.5, 2e4, 121 * 100.0], [1e-9, 1e-9, 1e-6])
    cut = float(re.search(r"m, ([\d.]+) m in all", printed)[1])
    assert f"{cut:.1f} m in all" in RECIPES["Cable net"]
    sag = float(re.search(r"sag ([\d.]+)", printed)[1])
    assert f"sags by {sag:.3f} m" in " ".join(RECIPES["Cable net"].split())


@pytest.mark.slow
def test_crush(cook):
    printed = cook("Crush test")
    peak, plateau = numbers(printed, "first peak", r"plateau stress \(20 to 40 %\)")
    mass = float(re.search(r"^ *mass +([\d.]+) kg", printed, flags=re.MULTILINE)[1])
    density = mass / 2700.0 / (0.02 * 0.02 * 0.03)
    compare("Crush test", [peak, plateau], [density * 200.0 / 3.0] * 2, [0.15, 0.15])
    assert f"{density:.4f} ·" in RECIPES["Crush test"]
    assert re.search(r"densification strain +none", printed) and "passed through each other" in printed


@pytest.mark.slow
def test_earthquake(cook):
    """Newton's law: the force of the supports is the rate of the momentum, and what the damping of masses takes."""
    printed = cook("Earthquake")
    ratio, shear = numbers(printed, "damping ratio", "base shear")
    history = open_result("results/quake").history
    momentum, force = history["momentum"][:, 0], history["support_force"][:, 0]
    drag = 2.0 * 0.05 * (2.0 * np.pi) * 2.5 * 10.0 / (2.5 + 10.0) * momentum
    rest = np.abs(np.gradient(momentum, history["time"]) + drag - force)
    jumps = [0.0, 0.1, 0.3, 0.4]  # of the acceleration of the ground
    smooth = np.abs(history["time"][:, None] - jumps).min(axis=1) > 0.007
    assert rest[smooth].max() < 5e-3 * shear
    figures = shown("Earthquake")
    assert same(figures["damping ratio, of the decay"][0], ratio, "damping ratio, of the decay")
    assert ratio == pytest.approx(0.05, rel=0.03) and same(
        figures["base shear [kN]"][0], shear / 1e3, "base shear [kN]"
    )
    assert 27.3e3 < shear < 4.0 * 27.3e3


@pytest.mark.slow
def test_oblique_impact(cook):
    values = numbers(cook("Oblique impact with friction"), "friction", "velocity along the floor")
    history = open_result("results/slide").history
    rebound = history["momentum"][-1, 2] / history["momentum"][0, 0] * 8.0
    compare("Oblique impact with friction", values, [0.2, 8.0 - 0.2 * (4.0 + rebound)], [6e-3, 2e-3])


@pytest.mark.slow
def test_own_law(cook):
    cook("Own material law")
    tip = open_result("results/pull").history["probe/tip/position"][-1, 0, 0] - 1.0
    strain = np.roots([100.0, 0.0, 1.0, -20.0 / (1e6 * 1e-4)])
    compare("Own material law", [tip], [strain[np.isreal(strain)].real[0]], [1e-9])
    assert Path("results/pull/curves.csv").exists()


@pytest.mark.slow
def test_part(cook):
    printed = cook("CAD file to dropped part")
    (contact,) = numbers(printed, "contact")
    mass = float(re.search(r"^  mass +([\d.]+) kg", printed, flags=re.MULTILINE)[1])
    volume = float(re.search(r"volume of bars over ([\d.e-]+) m3", printed)[1])
    density = 6.0 * np.sqrt(2.0) * 5e-8 / (0.006**2 / 2.0)
    hand = [1e3 * 4500.0 * density * volume, 1e6 * 2.0 * 0.078 / (np.sqrt(110e9 / 4500.0) / 3.0)]
    compare("CAD file to dropped part", [1e3 * mass, contact], hand, [0.03, 0.1])
    assert "plastic dissipation 0.0" in printed


@pytest.mark.slow
def test_study(cook):
    cook("Study on a cluster")
    table = np.genfromtxt("results/study/sweep.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    left = [table["kinetic_energy"][k] + table["elastic_energy"][k] for k in range(2)]
    compare("Study on a cluster", left, [0.125 * (1.0 - 0.5 / n) for n in (10, 20)], [2e-3, 2e-3])
