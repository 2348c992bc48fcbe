"""The folder examples: each file is a plugin, found by its name, and run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.pages import EXAMPLES, PLUGINS, TEXT, run
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import Case, Simulation, columns, open_result, registry
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.post.motion import wall_surfaces


def test_one_example_of_each_kind(examples):
    found = {package: sorted(modules) for package, modules in registry._plugins.items()}
    assert all(len(names) == 1 for names in found.values()), found
    assert sorted(f"{name}.py" for (name,) in found.values()) == list(PLUGINS)
    assert all(f"examples/{name}" in TEXT for name in PLUGINS)


@pytest.mark.slow
def test_case_of_the_folder_runs_where_it_is(own_registry, tmp_path):
    """Without the spin corners of the polygon hit the funnel after they fell 0.6 - 0.5 m at 1 m/s."""
    command = ["run", str(EXAMPLES / "polygon_spin.toml"), "-o", str(tmp_path / "out"), "--quiet"]
    assert main([*command, "--set", "initial.angular_velocity=[0,0,0]"]) == 0
    history = open_result(tmp_path / "out").history
    first = history["time"][np.flatnonzero(history["wall/funnel/contacts"])[0]]
    assert first == pytest.approx(0.1, abs=1.1e-3)


def test_they_are_listed(examples, capsys):
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    for name, text in (
        ("bdf2", "Second-order backward differences"),
        ("funnel", "A circular cone"),
        ("viscoplastic", "Viscoplastic bar with kinematic hardening"),
        ("polygon", "A regular polygon"),
        ("tether", "A bound on the distance of two nodes"),
        ("wire", "Wire files, text of our own"),
        ("listed", "Equilibria at listed load factors"),
        ("secant", "Held nodes have the mean normal velocity"),
        ("polygon_spin", "A polygon that spins inside a funnel"),
    ):
        assert re.search(rf"^  {name} +{text}", shown, flags=re.MULTILINE), name


@pytest.mark.slow
def test_integrator_follows_its_recursion(examples, comm, shared_tmp_path):
    """One bar with a mass at its end is x'' + w^2 x = 0, whose backward differences are solved here by themselves."""
    h, steps, w2 = 0.05, 40, 2.0
    keys = ["mesh.elements=1", "time.integrator=bdf2", f"time.step={h}", f"time.end={h * steps}"]
    keys += ["node_set.foot.nearest=[0, 0, 0]", 'support=[{node_set="foot", fix="xyz"}]', "wall=[]"]
    case = Case.load("rod_impact", [*keys, "initial.velocity=[0.01, 0, 0]"])
    run(case, comm, shared_tmp_path / "bar")
    x, v = [0.0], [0.01]
    for n in range(steps):
        b, known_x, known_v = (
            (1.0 / h, x[n], v[n]) if n == 0 else (1.5 / h, *((4 * q[n] - q[n - 1]) / 3 for q in (x, v)))
        )
        x.append((b * known_x + known_v) * b / (b * b + w2))
        v.append(b * (x[-1] - known_x))
    history = open_result(shared_tmp_path / "bar").history
    assert np.asarray(history["probe/tip/position"])[:, 0, 0] - 1.0 == pytest.approx(np.array(x), abs=1e-11)
    assert np.asarray(history["probe/tip/velocity"])[:, 0, 0] == pytest.approx(np.array(v), abs=1e-10)


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_to_the_last_bit(examples, comm, shared_tmp_path):
    """All of the examples in one case, stopped after the impact and continued."""
    history = assert_restart_is_bitwise(Case.load("polygon_spin"), comm, shared_tmp_path, 110)
    assert history["wall/funnel/contacts"][110] > 0


@pytest.mark.parallel
def test_field_is_one_entry(comm, shared_tmp_path):
    line = re.search(r"^```python\n(Field\(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1]
    entry = eval(line, {"Field": columns.Field})  # noqa: S307 - the text of our own page
    columns.FIELDS.append(entry)
    try:
        keys = ["mesh.elements=4", "time.end=0.2", "output.fields=['stretch', 'strain']"]
        run(Case.load("rod_impact", keys), comm, shared_tmp_path / "rod")
        run(Case.load("rod_impact", ["time.end=0.02"]), comm, shared_tmp_path / "other")
    finally:
        columns.FIELDS.remove(entry)
    result = open_result(shared_tmp_path / "rod")
    assert sorted(result.cell_fields) == ["strain", "stretch"] and not result.point_fields
    for k in range(len(result.times)):
        assert result.field("stretch", k) == pytest.approx(1.0 + result.field("strain", k), rel=1e-14)
    assert "stretch" not in open_result(shared_tmp_path / "other").cell_fields


@pytest.mark.slow
def test_energy_term_is_one_line(tmp_path):
    """In a copy of the package: the columns of a row are laid out when it is imported. What such a column is in batches
    of steps, ``tests/stepping/test_batches.py`` tests."""
    line = re.search(r"^```python\n(energy\(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1]
    package = Path(columns.__file__).parent
    shutil.copytree(package, tmp_path / package.name)
    path = tmp_path / package.name / "columns.py"
    text = path.read_text()
    path.write_text(text.replace("ENERGIES = (\n", f"ENERGIES = (\n    {line.strip()},\n", 1))
    command = [sys.executable, "-m", "pfem_petsc", "run", "pendulum", "--set", "initial.velocity=[0.0, 2.0, 0.0]"]
    command += ["--set", "time.end=0.02", "-o", str(tmp_path / "out")]
    # loops of another number of columns would all be compiled
    settings = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, env=settings, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    history = open_result(tmp_path / "out").history
    sideways = np.asarray(history["sideways_energy"])
    tip = 0.5 * (1000.0 * 1e-4)  # half of the bar's mass [kg]
    assert sideways == pytest.approx(0.5 * tip * history["probe/tip/velocity"][:, 0, 1] ** 2, rel=1e-12)
    assert len(sideways) == 21 and sideways.min() > 0.09
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * sideways[0]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator, treatment", [("bdf2", "secant"), ("central_differences", "scheme")])
def test_wall_pushes_along_its_normal(integrator, treatment, examples, comm, shared_tmp_path):
    keys = [
        f"time.integrator={integrator}",
        f"contact.treatment={treatment}",
        "output.fields_every=1",
        "solver.rtol=1e-12",
    ]
    run(Case.load("polygon_spin", keys), comm, shared_tmp_path / "run")
    result = open_result(shared_tmp_path / "run")
    history = {name: np.asarray(result.history[name]) for name in result.history}
    pushed = 0
    for index in range(len(result.times)):
        x = result.positions(index)
        radius = np.linalg.norm(x[:, :2], axis=1)
        assert (radius - x[:, 2] - 0.6).max() < 1e-12
        force = result.field("contact_force", index)
        held = np.linalg.norm(force, axis=1) > 0.0
        pushed += held.sum()
        inwards = np.column_stack([-x[held, :2] / radius[held, None], np.ones(held.sum())]) / np.sqrt(2.0)
        size = np.linalg.norm(force[held], axis=1)
        # a force of central differences was found at the next place
        turn = 1e-9 if integrator == "bdf2" else 0.02
        assert np.abs(force[held] - size[:, None] * inwards).max(initial=0.0) < turn * size.max(initial=1.0)
    assert pushed > 0
    impulse = history["wall/funnel/impulse"] + history["wall/funnel/jump_impulse"]
    gained = history["momentum"] - history["momentum"][0]
    scale = np.abs(history["momentum"][0]).max()
    assert np.abs(gained - impulse).max() < 1e-9 * scale
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"][0]


def test_wall_is_drawn(examples):
    (surface,) = wall_surfaces(Case.load("polygon_spin").wall, np.array([[-0.5, -0.5, -0.2], [0.5, 0.5, 0.0]]))
    radius, height = np.linalg.norm(surface.points[:, :2], axis=1), surface.points[:, 2] + 0.6
    assert radius == pytest.approx(height, abs=1e-12) and height.max() == pytest.approx(0.6)


@pytest.mark.parallel
@pytest.mark.parametrize("sides", [3, 12])
def test_polygon_has_its_mass_and_spin(sides, examples, comm, shared_tmp_path):
    """On three ranks a triangle has one corner on each."""
    case = Case.load("polygon_spin", [f"mesh.sides={sides}", "time.end=1e-3"])
    simulation = run(case, comm, shared_tmp_path / "run")
    mass = 1000.0 * 1e-4 * sides * 2.0 * 0.5 * np.sin(np.pi / sides)
    assert simulation.model.total_mass == pytest.approx(mass, rel=1e-14)
    history = open_result(shared_tmp_path / "run").history
    # lumped at the corners: L = M R^2 w, p = M v
    assert history["angular_momentum"][0] == pytest.approx([0.0, 0.0, mass * 0.25 * 4.0], rel=1e-13, abs=1e-13)
    assert history["momentum"][0] == pytest.approx([0.0, 0.0, -mass], rel=1e-13, abs=1e-13)


@pytest.mark.slow
def test_treatment_stops_the_chatter_of_the_trapezoidal_rule(examples, comm, shared_tmp_path):
    """With the scheme's own velocities the same rod gains energy tenfold (docs/contact_tables.md)."""
    keys = ["time.integrator=newmark", "time.beta=0.25", "time.gamma=0.5", "contact.treatment=secant"]
    keys += ["initial.velocity=[0.1, 0, 0]", "time.end=4.0", "output.fields_every=0"]
    run(Case.load("rod_impact", keys), comm, shared_tmp_path / "rod")
    history = {name: np.asarray(a) for name, a in open_result(shared_tmp_path / "rod").history.items()}
    energy = history["kinetic_energy"] + history["elastic_energy"]
    assert energy.max() < 1.001 * energy[0]
    assert history["wall/wall/releases"][-1] == 1
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * energy[0]
    x, v = history["probe/tip/position"][:, 0, 0], history["probe/tip/velocity"][:, 0, 0]
    held = np.flatnonzero(history["wall/wall/contacts"])
    assert len(held) > 100
    assert v[held] == pytest.approx((x[held] - x[held - 1]) / 0.01, abs=1e-10)


def test_treatment_states_what_it_goes_with(examples, comm, tmp_path):
    with pytest.raises(InputError, match='friction needs contact.treatment = "scheme" or "stick"'):
        Simulation(Case.load("polygon_spin", ["wall.0.friction=0.2"]), comm, output=tmp_path / "out", quiet=True)


def test_reader_of_a_mesh_format(examples, tmp_path):
    from pfem_petsc.formats import read_whole

    text = "# a square\nnode 0 0 0\nnode 1 0 0\nnode 1 1 0\nnode 0 1 0\ngroup frame\n"
    text += "bar 1 2\nbar 2 3\nbar 3 4\nbar 4 1\ngroup brace  # one\nbar 1 3\n"
    (tmp_path / "square.wire").write_text(text)
    mesh = read_whole(tmp_path / "square.wire")
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]]
    assert {name: members.tolist() for name, members in mesh.bar_groups.items()} == {
        "frame": [0, 1, 2, 3],
        "brace": [4],
    }
    assert main(["mesh", "convert", str(tmp_path / "square.wire"), str(tmp_path / "square.msh")]) == 0
    for wrong in ("node 0 0", "node 0 0 z", "nodes 0 0 0"):
        (tmp_path / "square.wire").write_text(text.replace("node 0 0 0", wrong))
        with pytest.raises(InputError, match="square.wire: line 2: .* expected node X Y Z, bar I J or group NAME"):
            read_whole(tmp_path / "square.wire")
