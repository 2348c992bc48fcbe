"""Modules of users: files that a case or the command line names, installed packages, and results without them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from helpers.launch import environment
from helpers.pages import PLUGINS, SPIN
from mpi4py import MPI

from pfem_petsc import Case, InputError, Simulation, registry
from pfem_petsc.cli.main import main

FILES = list(PLUGINS)


@pytest.fixture
def forgotten(monkeypatch):
    """Lets the registry forget the files that were added, as another process does not know them."""

    def forget():
        monkeypatch.setattr(registry, "_plugins", {package: {} for package in registry.KINDS})
        monkeypatch.setattr(registry, "_sources", {})

    return forget


@pytest.mark.slow
def test_results_open_without_the_plugins_of_their_case(
    plugin_files, examples, forgotten, monkeypatch, capsys, recwarn
):
    """Nothing is installed: the case names the files, relative to it; then the files are gone."""
    monkeypatch.chdir(plugin_files)
    (plugin_files / "spin.toml").write_text(f"plugins = {FILES}\n{SPIN}")
    forgotten()
    assert main(["spin.toml", "-o", "out", "--set", "time.end=0.01"]) == 0
    assert main(["check", "polygon_spin.toml", "--plugin", *FILES]) == 0
    assert "This case can run" in capsys.readouterr().out
    for name in FILES:
        (plugin_files / name).unlink()
    forgotten()
    drawn = ["--size", "160x120", "--frames", "1", "--video", "none"]
    for verb, options in {"info": [], "report": [], "plot": ["--curves", "kinetic_energy"], "render": drawn}.items():
        assert main([verb, "out", *options]) == 0
        text = " ".join([*capsys.readouterr(), *(str(recwarn.pop().message) for _ in recwarn.list)])
        for part in ("parts of the case are unknown: ", "law viscoplastic, a wall of type funnel", "integrator bdf2"):
            assert part in text, verb
        assert ("wall 'funnel' is left out of the picture: its type 'funnel' is unknown" in text) == (verb == "render")
    assert list((plugin_files / "out").glob("*.png"))


@pytest.mark.slow
def test_every_verb_takes_plugins(plugin_files, forgotten, monkeypatch, capfd):
    """A restart has those of its checkpoint; pictures show their walls; sweeps and meshes are made with them."""
    monkeypatch.chdir(plugin_files)
    forgotten()
    assert main(["polygon_spin.toml", "--quiet", "--plugin", *FILES, "--set", "time.end=0.01"]) == 0
    forgotten()
    assert main(["polygon_spin.toml", "--restart", "--set", "time.end=0.02"]) == 0
    kept = " ".join(str(plugin_files / name) for name in FILES)
    assert f"as in the run that is continued: --plugin {kept}" in capfd.readouterr().out
    (plugin_files / "cases").mkdir()
    for path in ("funnel.py", "polygon.py"):
        (plugin_files / path).rename(plugin_files / "cases" / path)
    forgotten()
    draw = ["render", "results/polygon_spin", "--frames", "2", "--video", "none", "--size", "160x120"]
    command = [sys.executable, "-m", "pfem_petsc", *draw]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=True)
    assert done.stderr.count("a wall of type funnel") == 1
    bare = (plugin_files / "results/polygon_spin/render.png").read_bytes()
    assert main([*draw, "--plugin", "cases/funnel.py"]) == 0
    said, told = capfd.readouterr()
    assert "left out" not in said and "funnel" not in told
    assert (plugin_files / "results/polygon_spin/render.png").read_bytes() != bare
    forgotten()
    again = ["polygon_spin.toml", "--quiet", "--restart", "--set", "time.end=0.03"]
    assert main(again) == 2
    missing = r"was given the plugin \S+/funnel.py, which is not there: give the file with --plugin \.\.\./funnel.py"
    assert re.search(missing, capfd.readouterr().err)
    moved = ["cases/funnel.py", "cases/polygon.py"]
    assert main([*again, "--plugin", *moved]) == 0
    forgotten()
    files = [name for name in FILES if not (plugin_files / "cases" / name).exists()]
    vary = ["--vary", "time.step=1e-3,2e-3", "--set", "time.end=0.01"]
    assert main(["sweep", "polygon_spin.toml", "--quiet", *vary, "--plugin", *files, *moved]) == 0
    forgotten()
    make = ["mesh", "generate", "polygon", "ring.h5", "--set", "radius=1", "sides=5"]
    assert main(make) == 2
    assert main([*make, "--plugin", *moved]) == 0
    assert "ring.h5: 5 nodes, 5 bars" in capfd.readouterr().out
    assert main(["list", "--plugin", "none.py"]) == 2
    assert "error: --plugin none.py: this plugin cannot be read: " in capfd.readouterr().err


def test_a_case_names_its_plugins(plugin_files, examples, forgotten):
    forgotten()
    with pytest.raises(InputError, match="unknown value"):
        Case.from_toml(SPIN, plugin_files)
    case = Case.from_toml(f"plugins = {FILES}\n{SPIN}", plugin_files)
    assert case.plugins == tuple(str(plugin_files / name) for name in FILES)
    assert Case.from_toml(case.to_toml(), "/elsewhere") == case == case.copy()
    assert case.wall[0].half_angle == 45.0
    again = Case.load(plugin_files / "polygon_spin.toml", plugins=[plugin_files / name for name in FILES])
    assert again == case and again.added == again.copy().added == case.plugins
    listed = ["plugins=['bdf2.py']"]
    assert Case.load(plugin_files / "polygon_spin.toml", listed, plugins=case.plugins).plugins[1:] == case.plugins


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("nothing.py", "x = 1\n", "this is no plugin: expected a file NAME.py that defines one of Scheme, LAW, "),
        ("broken.py", "LAW = (\n", "this plugin cannot be read: .*was never closed"),
        ("fails.py", "LAW = 1 / 0\n", "this plugin cannot be imported: ZeroDivisionError"),
        ("elastic.py", "LAW = 1\n", "has a module elastic of its own: give the plugin another name"),
    ],
)
def test_what_is_no_plugin_is_refused(tmp_path, name, text, told):
    (tmp_path / name).write_text(text)
    data = Case.load("rod_impact").to_dict()
    with pytest.raises(InputError, match=rf'plugins\[0\] = "{name}": .*{told}'):
        Case.from_dict({"plugins": [name], **data}, folder=tmp_path)
    with pytest.raises(InputError, match=r'plugins\[0\] = "none.py": this plugin cannot be read'):
        Case.from_dict({"plugins": ["none.py"], **data}, folder=tmp_path)


LAW = PLUGINS["viscoplastic.py"]
RETURNED = "return stress, tangent, (plastic, back, heat), (elastic, heat, 0.5 * back * back / hardening)"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            RETURNED,
            "return stress, tangent",
            r"response returned \(0.0, 1000000.0\); it must return \(stress, tangent, ",
        ),
        (RETURNED, "return stress, tangent, q, (elastic,)", r"tuples of the lengths that LAW has: 3 and 3"),
        (RETURNED, "return stress, tangent, q, elastic", r"tuples of the lengths that LAW has: 3 and 3"),
        ("relative = young", "relative = youn", r"response raised NameError: .*\(\S+viscoplastic.py, line \d+\)"),
        ("return self.young_modulus, self.yield_stress, ", "return ", "response raised ValueError: not enough values"),
        ("return self.young_modulus, ", "return self.young_modulus #", r"Parameters.pack returned 1000000.0; it must"),
    ],
)
def test_wrong_laws_are_refused(plugin_files, forgotten, old, new, told):
    forgotten()
    assert LAW.count(old) >= 1
    (plugin_files / "viscoplastic.py").write_text(LAW.replace(old, new, 1))
    text = rf'material.default.law = "viscoplastic": {plugin_files}/viscoplastic.py: .*{told}'
    with pytest.raises(InputError, match=text):
        Case.load(plugin_files / "polygon_spin.toml", plugins=[plugin_files / name for name in FILES])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("return normals, ", "return 2.0 * normals, ", r"planes returned the normal \[.*\] and the offset .* at \["),
        ("return normals, normals @ self.centre", "return normals, np.nan * normals[:, 0]", ".*the offset nan at"),
        ("return normals, normals @ self.centre", "return normals, 0.0", r"planes returned \[\(12, 3\), \(\)\]"),
        ("return normals, normals @ self.centre", "return normals", "planes returned ndarray"),
        ("def planes(", "def plane(", "it raised TypeError: .* abstract method '?planes"),
        ("arm = x - ", "arm = y - ", r"it raised NameError: .*\(\S+funnel.py, line \d+\)"),
        ("self.centre = ", "self.centre, self.apex = 0.0, ", r"its centre is 0.0; it must be an array \(3,\)"),
        (
            "    def planes(",
            "    flat, normal, offset = True, (0, 0, 2), 0.0\n\n    def planes(",
            "its normal is .*unit",
        ),
    ],
)
def test_wrong_walls_are_refused(plugin_files, tmp_path, forgotten, old, new, told):
    forgotten()
    code = PLUGINS["funnel.py"]
    assert code.count(old) >= 1
    (plugin_files / "funnel.py").write_text(code.replace(old, new, 1))
    case = Case.load(plugin_files / "polygon_spin.toml", plugins=[plugin_files / name for name in FILES])
    with pytest.raises(InputError, match=f"wall 'funnel': {plugin_files}/funnel.py: the class Wall: {told}"):
        Simulation(case, MPI.COMM_SELF, check_only=True)


@pytest.mark.slow
def test_walls_of_stages_are_left_out_of_pictures(plugin_files, forgotten, monkeypatch, capsys):
    monkeypatch.chdir(plugin_files)
    forgotten()
    data = Case.load("polygon_spin.toml", plugins=FILES).to_dict()
    wall, time, _ = data.pop("wall"), data.pop("time") | {"end": 0.004}, data.pop("initial")
    data["stage"] = [{"time": time}, {"time": time, "wall": wall}]
    with Simulation(Case.from_dict(data), MPI.COMM_SELF, output="out", quiet=True) as simulation:
        simulation.run()
    forgotten()
    with pytest.warns(UserWarning, match="a wall of type funnel"):
        assert main(["render", "out", "--frames", "2", "--video", "none", "--size", "160x120"]) == 0
    assert "'funnel' is left out of the picture" in capsys.readouterr().out


@pytest.mark.slow
def test_other_failures_name_the_plugin(plugin_files, forgotten, monkeypatch, capsys):
    monkeypatch.chdir(plugin_files)
    words = ["polygon_spin.toml", "--quiet", "--plugin", *FILES]
    plain = "def other(x):\n    return abs(x)\n\n\n@register_jitable\ndef response"
    for name, changes, status, told in (
        ("bdf2.py", {"state.a = ": "state.a = one * "}, 3, "in finish: NameError: name 'one' is not defined"),
        (
            "viscoplastic.py",
            {"@register_jitable\ndef response": plain, "= abs(relative)": "= other(relative)"},
            2,
            "this cannot be compiled: Untyped global name 'other'",
        ),
    ):
        forgotten()
        code = PLUGINS[name]
        for old, new in changes.items():
            code = code.replace(old, new, 1)
        (plugin_files / name).write_text(code)
        assert main(words) == status
        error = capsys.readouterr().err
        assert error.startswith(f"error: the plugin {plugin_files / name}, line ") and told in error
        (plugin_files / name).write_text(PLUGINS[name])


def test_installed_packages_add_modules_by_entry_points(tmp_path, monkeypatch):
    (tmp_path / "soft_laws.py").write_text(LAW)
    info = tmp_path / "soft_laws-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: soft_laws\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pfem_petsc.laws]\nsoft = soft_laws\nbad = no_such_module\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_every_entry_point", registry.entry_points)
    registry._installed.cache_clear()
    try:
        laws = "pfem_petsc.mechanics.materials"
        assert {"soft", "bad", "elastic"} <= set(registry.choices(laws))
        assert registry.lookup(laws, "soft", "").__name__ == "soft_laws"
        assert registry.description(laws, "soft").startswith("Viscoplastic bar")
        with pytest.raises(InputError, match=r"material\.law: no_such_module cannot be imported: ModuleNotFoundError"):
            registry.lookup(laws, "bad", "material.law")
    finally:
        registry._installed.cache_clear()
