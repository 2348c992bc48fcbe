"""The examples of CONTRIBUTING.md: each is put into the package as one file, found by its name, and run."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, fields, open_result
from pfem_petsc.case import builtin
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.post.walls import wall_surfaces

TEXT = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text()
PACKAGES = (
    *("integrators", "contact.walls", "contact.constraints", "mesh.generators", "mechanics.materials"),
    "contact.treatments",
)
EXAMPLES = {
    path: code
    for code, path in re.findall(
        r"^```(?:python|toml)\n(# pfem_petsc/(\S+)\n.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL
    )
}


def test_one_example_of_each_kind():
    folders = [path.rpartition("/")[0].replace("/", ".") for path in EXAMPLES]
    assert sorted(folders) == sorted([*PACKAGES, "cases"])


@pytest.fixture
def examples(monkeypatch, comm, shared_tmp_path):
    """The package with the examples' files in its folders."""
    root = shared_tmp_path / "added"
    if comm.rank == 0:
        shutil.copytree(builtin.FOLDER, root / "cases")
        for path, code in EXAMPLES.items():
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_text(code)
    comm.Barrier()
    importlib.invalidate_caches()
    for name in PACKAGES:
        package = importlib.import_module(f"pfem_petsc.{name}")
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(root / name.replace(".", "/"))])
    monkeypatch.setattr(builtin, "FOLDER", root / "cases")
    yield
    for path in EXAMPLES:
        module = "pfem_petsc." + path.removesuffix(".py").replace("/", ".")
        if module in sys.modules:
            del sys.modules[module]
            parent, _, name = module.rpartition(".")
            delattr(sys.modules[parent], name)


def test_they_are_listed(examples, capsys):
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    for name, text in (
        ("bdf2", "Second-order backward differences"),
        ("funnel", "A circular cone"),
        ("viscoplastic", "Viscoplastic bar with kinematic hardening"),
        ("polygon", "A regular polygon"),
        ("tether", "A bound on the distance of two nodes"),
        ("secant", "Held nodes have the mean normal velocity"),
        ("polygon_spin", "A polygon that spins inside a funnel"),
    ):
        assert re.search(rf"^  {name} +{text}", shown, flags=re.MULTILINE), name


def run(case, comm, folder, **options):
    with Simulation(case, comm, output=folder, quiet=True, **options) as simulation:
        simulation.run()
        comm.Barrier()
        return simulation


@pytest.mark.parallel
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


@pytest.mark.parallel
def test_restart_to_the_last_bit(examples, comm, shared_tmp_path):
    """All of the examples in one case, stopped after the impact and continued."""
    whole, parts = shared_tmp_path / "whole", shared_tmp_path / "parts"
    run(Case.load("polygon_spin"), comm, whole)
    run(Case.load("polygon_spin", ["time.end=0.11"]), comm, parts)
    run(Case.load("polygon_spin"), comm, parts, restart=True)
    one, other = open_result(whole), open_result(parts)
    assert one.history["wall/funnel/contacts"][110] > 0
    assert list(one.history) == list(other.history)
    for name in one.history:
        assert np.asarray(one.history[name]).tobytes() == np.asarray(other.history[name]).tobytes(), name
    assert one.field("displacement", -1).tobytes() == other.field("displacement", -1).tobytes()


LAW = {"young_modulus": 1e6, "density": 1000.0, "yield_stress": 2e3, "hardening": 1e5, "viscosity": 500.0}
LAW |= {"law": "viscoplastic", "rate_viscosity": 20.0}
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}  # the trapezoidal rule
VARIABLES = ("plastic_strain", "back_stress", "dissipated_density")


def one_bar(integrator, h, steps, **more):
    """A bar of 1 m along x, 1 cm2: its foot is held, its tip has 0.05 kg and is thrown."""
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"foot": {"nearest": [0.0, 0.0, 0.0]}, "tip": {"nearest": [1.0, 0.0, 0.0]}},
            "material": {"it": LAW},
            "section": {"it": {"area": 1e-4, "material": "it"}},
            "initial": {"on": [{"node_set": "tip", "velocity": [0.5, 0.0, 0.0]}]},
            "support": [{"node_set": "foot", "fix": "xyz"}],
            "time": {"integrator": integrator, "step": h, "end": h * steps, **PARAMETERS.get(integrator, {})},
            "solver": {"rtol": 1e-13, **more},
            "output": {
                "fields_every": 1,
                "fields": ["stress", *VARIABLES],
                "probe": [{"name": "tip", "node_set": "tip"}],
            },
        }
    )


def viscoplastic(strain, before, h, q):
    """Stress and internal variables after a step, by the equations of the law alone."""
    plastic, back, heat = q
    over = 1e6 * (strain - plastic) - back
    rate = (strain - before) / h
    if abs(over) > 2e3:
        # eta de_p/h = |E (e - e_p) - b| - s_Y with e_p and b at the end
        flow = np.sign(over) * (abs(over) - 2e3) / (1e6 + 1e5 + 500.0 / h)
        plastic, back = plastic + flow, back + 1e5 * flow
        heat += (1e6 * (strain - plastic) - back) * flow
    return 1e6 * (strain - plastic) + 20.0 * rate, (plastic, back, heat + 20.0 * rate * rate * h)


def thrown(integrator, h, steps):
    """Displacements of the tip, stresses and internal variables of the bar, step by step."""
    area_over_mass = 1e-4 / 0.05
    x, v, a, half, stress, q = 0.0, 0.5, 0.0, 0.5, 0.0, (0.0, 0.0, 0.0)
    rows = [(x, stress, *q)]
    for _ in range(steps):
        end = x + h * half
        if integrator == "central_differences":
            half -= h * area_over_mass * viscoplastic(end, x, h, q)[0]
        else:
            for _ in range(40):  # a contraction by (w h)^2/4
                force = viscoplastic(end, x, h, q)[0]
                if integrator == "newmark":
                    end = x + h * v + 0.25 * h * h * (a - area_over_mass * force)
                else:
                    end = x + h * v - 0.5 * h * h * area_over_mass * 0.5 * (stress + force)
            v = 2.0 * (end - x) / h - v
        stress, q = viscoplastic(end, x, h, q)
        x, a, half = end, -area_over_mass * stress, half if integrator == "central_differences" else v
        rows.append((x, stress, *q))
    return np.array(rows)


@pytest.mark.parallel
@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "energy_momentum"])
def test_law_is_integrated_as_by_itself(integrator, operator, examples, comm, shared_tmp_path):
    """The response of one bar, in each kind of step, against its equations written once more."""
    if operator == "matrix_free" and integrator != "newmark":
        pytest.skip("a Hessian without a matrix is that of symmetric implicit schemes")
    more = {"operator": operator, "linear": "cg"} if operator == "matrix_free" else {}
    run(one_bar(integrator, 2e-3, 120, **more), comm, shared_tmp_path / "bar")
    result = open_result(shared_tmp_path / "bar")
    expected = thrown(integrator, 2e-3, 120)
    moved = np.asarray(result.history["probe/tip/position"])[:, 0, 0] - 1.0
    assert np.abs(moved - expected[:, 0]).max() < 1e-10 * np.abs(expected[:, 0]).max()
    for column, name in enumerate(("stress", *VARIABLES), start=1):
        found = np.array([result.field(name, k)[0] for k in range(len(result.times))])
        assert np.abs(found - expected[:, column]).max() < 1e-10 * np.abs(expected[:, column]).max(), name
    assert np.abs(expected[:, 2]).max() > 1e-3 and (np.diff(expected[:, 4]) >= 0.0).all()
    energy = np.asarray(result.history["kinetic_energy"])
    assert np.abs(result.history["energy_imbalance"]).max() < 1e-10 * energy[0]
    heat = np.asarray(result.history["plastic_heat"])
    assert heat == pytest.approx(1e-4 * expected[:, 4], rel=1e-9, abs=1e-12)


def test_law_in_the_fused_loop(examples, tmp_path):
    """Many steps in one call are the single steps to the last bit."""
    case, found = one_bar("central_differences", 2e-3, 200), []
    for together in (False, True):
        with Simulation(case, output=tmp_path / str(together), quiet=True) as simulation:
            count = len(list(simulation.batches(min_steps=1) if together else simulation))
            found.append((count, simulation.state.x.copy(), simulation.model.bars.history()))
    assert found[0][0] == 200 and np.array_equal(found[0][1], found[1][1]) and np.array_equal(found[0][2], found[1][2])
    assert np.abs(found[0][2]).max() > 0.0


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "chung_lee", "energy_momentum"])
def test_law_restarts_to_the_last_bit(integrator, examples, comm, shared_tmp_path):
    """A chain that yields, stopped on the way: positions, and internal variables in snapshots and checkpoints."""
    keys = ["mesh.elements=6", "output.checkpoint_every=20"]
    base = one_bar(integrator, 2e-4, 60).to_dict()
    whole, parts = shared_tmp_path / "whole", shared_tmp_path / "parts"
    one = run(Case.from_dict(base, overrides=keys), comm, whole)
    run(Case.from_dict(base, overrides=[*keys, "time.end=0.008"]), comm, parts)
    other = run(Case.from_dict(base, overrides=keys), comm, parts, restart=True)
    assert one.model.bars.kept_names == [*VARIABLES, "last_strain", "last_stress"]
    assert one.model.bars.history().tobytes() == other.model.bars.history().tobytes()
    first, second = open_result(whole), open_result(parts)
    for name in first.history:
        assert np.asarray(first.history[name]).tobytes() == np.asarray(second.history[name]).tobytes(), name
    for name in ("stress", *VARIABLES):
        assert first.field(name, -1).tobytes() == second.field(name, -1).tobytes(), name
        assert np.abs(first.field(name, -1)).max() > 0.0, name


def test_law_without_mean_stress_is_refused_by_the_energy_momentum_scheme(examples, monkeypatch, tmp_path, capsys):
    module = importlib.import_module("pfem_petsc.mechanics.materials.viscoplastic")
    monkeypatch.setattr(module, "LAW", dataclasses.replace(module.LAW, mean_stress=None))
    path = tmp_path / "bar.toml"
    path.write_text(one_bar("energy_momentum", 2e-3, 10).to_toml())
    assert main(["run", str(path), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert 'material.it.law = "viscoplastic" does not go with time.integrator = "energy_momentum"' in said
    assert "mean_stress" in said and "take another integrator or law" in said


def test_unknown_law_and_keys_of_another_are_refused(examples):
    table = one_bar("newmark", 2e-3, 10).to_dict()
    for changes, words in (
        ({"law": "viscoplastik"}, ["material.it.law", "unknown value", "did you mean 'viscoplastic'?"]),
        ({"law": "elastoplastic"}, ["material.it.hardening", "a key of viscoplastic, not of the law elastoplastic"]),
    ):
        with pytest.raises(InputError) as error:
            Case.from_dict(table | {"material": {"it": LAW | changes}})
        assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parallel
def test_field_is_one_entry(comm, shared_tmp_path):
    line = re.search(r"^```python\n(Field\(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1]
    entry = eval(line, {"Field": fields.Field})  # noqa: S307 - the text of our own page
    fields.FIELDS.append(entry)
    try:
        keys = ["mesh.elements=4", "time.end=0.2", "output.fields=['stretch', 'strain']"]
        run(Case.load("rod_impact", keys), comm, shared_tmp_path / "rod")
        run(Case.load("rod_impact", ["time.end=0.02"]), comm, shared_tmp_path / "other")
    finally:
        fields.FIELDS.remove(entry)
    result = open_result(shared_tmp_path / "rod")
    assert sorted(result.cell_fields) == ["strain", "stretch"] and not result.point_fields
    for k in range(len(result.times)):
        assert result.field("stretch", k) == pytest.approx(1.0 + result.field("strain", k), rel=1e-14)
    assert "stretch" not in open_result(shared_tmp_path / "other").cell_fields


def test_energy_term_is_one_line(tmp_path):
    """In a copy of the package: the columns of a row are laid out when it is imported."""
    line = re.search(r"^```python\n(Energy\(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1]
    package = Path(fields.__file__).parent
    shutil.copytree(package, tmp_path / package.name)
    path = tmp_path / package.name / "energies.py"
    text = path.read_text()
    path.write_text(text.replace("ENERGIES = (\n", f"ENERGIES = (\n    {line.strip()},\n", 1))
    command = [sys.executable, "-m", "pfem_petsc", "run", "pendulum", "--set", "initial.velocity=[0.0, 2.0, 0.0]"]
    command += ["--set", "time.end=0.02", "-o", str(tmp_path / "out")]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(tmp_path)}, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    history = open_result(tmp_path / "out").history
    sideways = np.asarray(history["sideways_energy"])
    assert sideways[0] == pytest.approx(np.asarray(history["kinetic_energy"])[0], rel=1e-14) and sideways[0] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * sideways[0]


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


@pytest.mark.parallel
def test_treatment_stops_the_chatter_of_the_trapezoidal_rule(examples, comm, shared_tmp_path):
    """With the scheme's own velocities the same rod gains energy tenfold (docs/contact.md)."""
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


LOOSE = ["mesh.elements=1", "material.default.young_modulus=1e-9", "wall=[]", "output.fields_every=0"]
"""A rod whose bars bear nothing: point masses."""
QUARTER = 1.8540746773013719 / np.sqrt(9.81)
"""Time [s] that a pendulum of 1 m takes from the horizontal to its lowest point: K(1/2) sqrt(l/g)."""


def history_of(folder) -> dict[str, np.ndarray]:
    history = open_result(folder).history
    return {name: np.asarray(history[name]) for name in history}


def tether(first: str, second: str, length: float, bound: str = "at_most") -> str:
    keys = f'name="rope", kind="tether", first="{first}", second="{second}", length={length!r}, bound="{bound}"'
    return f"constraint=[{{{keys}}}]"


def pendulum(integrator: str, steps: int, *keys: str) -> Case:
    """A point mass of 0.5 kg falls on a tether of 1 m, from the horizontal to the lowest point."""
    own = ["node_set.foot.nearest=[0, 0, 0]", 'support=[{node_set="foot", fix="xyz"}]', "initial.velocity=[0, 0, 0]"]
    own += [f"time.integrator={integrator}", f"time.step={QUARTER / steps!r}", f"time.end={QUARTER!r}"]
    own += ["gravity.acceleration=[0, 0, -9.81]", tether("foot", "tip", 1.0), "solver.rtol=1e-12"]
    return Case.load("rod_impact", [*LOOSE, *own, *keys])


@pytest.mark.parallel
@pytest.mark.parametrize("integrator, error", [("central_differences", 8e-4), ("chung_lee", 2e-2), ("houbolt", 6e-3)])
def test_pendulum_on_a_tether(integrator, error, examples, comm, shared_tmp_path):
    """Against elliptic integrals: place, velocity sqrt(2 g l) and tension 3 m g at the lowest point, after
    K(1/2) sqrt(l/g), with errors of second order; its length to rounding."""
    errors = []
    for steps in (50, 100):
        run(pendulum(integrator, steps), comm, shared_tmp_path / str(steps))
        history = history_of(shared_tmp_path / str(steps))
        x, v = history["probe/tip/position"][:, 0], history["probe/tip/velocity"][:, 0]
        force = history["constraint/rope/force"]
        assert np.linalg.norm(x, axis=1) == pytest.approx(np.ones(steps + 1), abs=1e-14)
        assert (history["active_contacts"][1:] == 2).all()
        energy = history["kinetic_energy"] - history["external_work"]
        assert np.abs(history["energy_imbalance"]).max() < 1e-9
        speed = abs(v[-1, 0] / -np.sqrt(2.0 * 9.81) - 1.0)
        errors.append(np.array([abs(x[-1, 0]), speed, np.abs(energy).max() / 4.905, abs(force[-1, 2] / 14.715 - 1.0)]))
    assert errors[1].max() < error
    assert (errors[1] < 0.3 * errors[0] + 1e-6).all()


def two_rods(integrator: str, rope: str, *keys: str) -> Case:
    """Two rods of 1 m fly apart, askew, between their ends 0.1 m of room and a tether."""
    own = ["mesh.length=1.0", "mesh.elements=3", "mesh.gap=0.1", 'node_set.tip={group="first_end"}', "wall=[]", rope]
    own = ["mesh.generator=two_rods", *own, "node_set.other.group=second_start", "node_set.right.indices=[4, 5, 6, 7]"]
    own += ["node_set.left.indices=[0, 1, 2, 3]", f"time.integrator={integrator}", "time.step=0.02", "time.end=1.5"]
    own += ['initial.on=[{node_set="right", velocity=[0.3, 0.1, -0.05]}]', "initial.velocity=[-0.3, 0.0, 0.2]"]
    return Case.load("rod_impact", [*own, "output.fields_every=1", "solver.rtol=1e-12", *keys])


@pytest.mark.parallel
@pytest.mark.parametrize(
    "integrator, keys",
    [
        ("central_differences", ()),
        ("central_differences", ("time.mass=consistent",)),
        ("newmark", ("solver.operator=assembled", "solver.linear=cg")),
        ("newmark", ("solver.operator=matrix_free", "solver.linear=cg")),
        ("energy_momentum", ()),
        ("generalized_alpha", ()),
    ],
)
def test_tether_between_bodies(integrator, keys, examples, comm, shared_tmp_path):
    """Momentum stays to rounding, and that of each body changes by the impulse; the distance is never above the length;
    the force is along the line between the nodes and never pushes."""
    run(two_rods(integrator, tether("tip", "other", 0.2), *keys), comm, shared_tmp_path / "run")
    result, history = open_result(shared_tmp_path / "run"), history_of(shared_tmp_path / "run")
    start = history["momentum"][0]
    assert np.abs(history["momentum"] - start).max() < 1e-11 * np.abs(start).max()
    turned = history["angular_momentum"] - history["angular_momentum"][0]
    assert np.abs(turned).max() < (1e-11 if integrator == "central_differences" and not keys else 2e-2)
    force, taut = history["constraint/rope/force"], 0
    for index in range(len(result.times)):
        x = result.positions(index)
        arm = x[4] - x[3]
        distance = np.linalg.norm(arm)
        assert distance < 0.2 + 1e-13
        pull = -force[index] @ arm / distance
        assert pull >= 0.0
        if pull > 0.0:
            taut += 1
            assert np.abs(force[index] + pull * arm / distance).max() < 1e-9 * pull
    assert taut > 3
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"][0]


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_tether_restarts_to_the_last_bit(integrator, examples, comm, shared_tmp_path):
    whole, parts, rope = shared_tmp_path / "whole", shared_tmp_path / "parts", tether("tip", "other", 0.2)
    keys = rope, "solver.linear=cg"  # MUMPS, which small models take on several ranks, repeats to rounding only
    run(two_rods(integrator, *keys), comm, whole)
    pulls = np.flatnonzero(history_of(whole)["constraint/rope/force"].any(axis=1))
    run(two_rods(integrator, *keys, f"time.end={0.02 * pulls[1]!r}"), comm, parts)
    run(two_rods(integrator, *keys), comm, parts, restart=True)
    one, other = history_of(whole), history_of(parts)
    assert list(one) == list(other)
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name
    assert open_result(whole).field("velocity", -1).tobytes() == open_result(parts).field("velocity", -1).tobytes()


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_strut_is_a_contact_pair_on_a_line(integrator, examples, comm, shared_tmp_path):
    """Rods that meet end on: a least distance and a pair bound the same number."""
    keys = ['initial.on=[{node_set="right", velocity=[-0.3, 0, 0]}]', "initial.velocity=[0.3, 0, 0]"]
    pair = 'contact_pair=[{name="rope", first="tip", second="other", direction=[1, 0, 0], gap=0.04}]'
    run(two_rods(integrator, tether("tip", "other", 0.04, "at_least"), *keys), comm, shared_tmp_path / "strut")
    run(two_rods(integrator, pair, *keys), comm, shared_tmp_path / "pair")
    strut, pairs = history_of(shared_tmp_path / "strut"), history_of(shared_tmp_path / "pair")
    assert pairs["pair/rope/force"].any()
    for what in ("force", "impulse"):
        expected = pairs[f"pair/rope/{what}"]
        np.testing.assert_allclose(strut[f"constraint/rope/{what}"], expected, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(strut["kinetic_energy"], pairs["kinetic_energy"], rtol=1e-10)


def chain(integrator: str, *keys: str) -> Case:
    """Five point masses on a chain of tethers that share nodes, hanging along x, or falling from there."""
    own = ["mesh.elements=5", "node_set.foot.nearest=[0, 0, 0]", 'support=[{node_set="foot", fix="xyz"}]']
    own += ["node_set.upper.indices=[0, 1, 2, 3, 4]", "node_set.lower.indices=[1, 2, 3, 4, 5]"]
    own += [f"time.integrator={integrator}", "time.step=5e-3", "time.end=0.25", "initial.velocity=[0, 0, 0]"]
    own += [tether("upper", "lower", 0.2), "solver.rtol=1e-12", "gravity.acceleration=[9.81, 0, 0]"]
    return Case.load("rod_impact", [*LOOSE, *own, "output.fields_every=1", *keys])


@pytest.mark.parallel
@pytest.mark.parametrize("integrator, mass", [("central_differences", "lumped"), ("newmark", "consistent")])
def test_chain_of_tethers_hangs_at_rest(integrator, mass, examples, comm, shared_tmp_path):
    """Each tether bears the weight below it, from the first row of the history on."""
    run(chain(integrator, f"time.mass={mass}"), comm, shared_tmp_path / "run")
    history = history_of(shared_tmp_path / "run")
    weights = 9.81 * np.array([0.2, 0.2, 0.2, 0.2, 0.1])
    pull = -weights[::-1].cumsum().sum()
    assert history["constraint/rope/force"][:, 0] == pytest.approx(np.full(51, pull), rel=1e-9)
    assert history["support_force"][:, 0] == pytest.approx(np.full(51, -9.81), rel=1e-9)
    assert np.abs(history["probe/tip/position"][:, 0, 0] - 1.0).max() < 1e-12
    assert history["kinetic_energy"].max() < 1e-20


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "houbolt"])
def test_chain_of_tethers_falls_on_a_floor(integrator, examples, comm, shared_tmp_path):
    """Rows that share nodes, and a floor that stops the same nodes: all are kept, and momentum is what was given."""
    wall = 'wall=[{name="floor", type="plane", point=[0, 0, -0.3], normal=[0, 0, 1]}]'
    keys = ["gravity.acceleration=[0, 0, -9.81]", wall, "time.end=0.5"]
    run(chain(integrator, *keys), comm, shared_tmp_path / "run")
    result, history = open_result(shared_tmp_path / "run"), history_of(shared_tmp_path / "run")
    for index in range(len(result.times)):
        x = result.positions(index)
        assert np.linalg.norm(np.diff(x, axis=0), axis=1).max() < 0.2 + 1e-12
        assert x[:, 2].min() > -0.3 - 1e-12
    assert history["wall/floor/contacts"].max() >= 3
    given = history["external_impulse"] + history["support_impulse"] + history["wall/floor/impulse"]
    assert np.abs(history["momentum"] - given).max() < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-8


@pytest.mark.parametrize(
    "keys, message",
    [
        ((tether("tip", "other", 0.05),), r"constraint 'rope': nodes 3, 4 start 0.05 m beyond it"),
        ((tether("tip", "tip", 0.2),), r"constraint 'rope': node 3 is constrained with itself"),
        ((tether("tip", "right", 0.2),), r"constraint 'rope': first has 1 nodes and second 4"),
        ((tether("tip", "nowhere", 0.2),), r"constraint\[0\].second = \"nowhere\" .*: there is no node set"),
        (
            (tether("tip", "other", 0.2).replace("tether", "rope"),),
            r"kind = \"rope\": unknown value, did you mean|known: tether",
        ),
        ((tether("tip", "other", 0.2), "contact.treatment=stick"), r"constraints need contact.treatment = \"scheme\""),
        (
            (tether("tip", "other", 0.2), 'wall=[{type="sphere", point=[0, 0, 9], radius=1.0, side="outside"}]'),
            r"wall 'wall1' stops constrained nodes",
        ),
        (
            (
                tether("tip", "other", 0.2),
                'contact_pair=[{first="tip", second="other", direction=[1, 0, 0]}]',
            ),
            "in a contact_pair as well",
        ),
    ],
)
def test_tethers_that_are_refused(keys, message, examples, comm, shared_tmp_path):
    with pytest.raises(InputError, match=message):
        run(two_rods("newmark", *keys), comm, shared_tmp_path / "run")
