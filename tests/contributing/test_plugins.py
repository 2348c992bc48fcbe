"""Modules of users: files that a case or the command line names, installed packages, and results without them."""

from __future__ import annotations

import pytest
from helpers.pages import EXAMPLES

from pfem_petsc import Case, InputError, registry
from pfem_petsc.cli.main import main

FILES = sorted(path.rpartition("/")[2] for path in EXAMPLES if path.endswith(".py"))
CASE = next(code for path, code in EXAMPLES.items() if path.endswith(".toml"))


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
    (plugin_files / "spin.toml").write_text(f"plugins = {FILES}\n{CASE}")
    forgotten()
    assert main(["spin.toml", "-o", "out", "--set", "time.end=0.01"]) == 0
    assert main(["check", "polygon_spin.toml", "--plugin", *FILES]) == 0
    assert "This case can run" in capsys.readouterr().out
    for name in FILES:
        (plugin_files / name).unlink()
    forgotten()
    for verb in ("info", "report", "plot", "render"):
        assert main([verb, "out", *(["--size", "160x120"] if verb == "render" else [])]) == 0
        text = " ".join([*capsys.readouterr(), *(str(recwarn.pop().message) for _ in recwarn.list)])
        assert "a wall of type funnel" in text and "the law viscoplastic" in text and "not there" in text, verb
    assert list((plugin_files / "out").glob("*.png"))


def test_a_case_names_its_plugins(plugin_files, examples, forgotten):
    forgotten()
    with pytest.raises(InputError, match="unknown value"):
        Case.from_toml(CASE, plugin_files)
    case = Case.from_toml(f"plugins = {FILES}\n{CASE}", plugin_files)
    assert case.plugins == tuple(str(plugin_files / name) for name in FILES)
    assert Case.from_toml(case.to_toml(), "/elsewhere") == case == case.copy()
    assert case.wall[0].half_angle == 45.0
    again = Case.load(plugin_files / "polygon_spin.toml", plugins=[plugin_files / name for name in FILES])
    assert again == case


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


def test_installed_packages_add_modules_by_entry_points(tmp_path, monkeypatch):
    code = next(code for path, code in EXAMPLES.items() if path.endswith("viscoplastic.py"))
    absolute = code.replace("...case", "pfem_petsc.case").replace(
        "from .base", "from pfem_petsc.mechanics.materials.base"
    )
    (tmp_path / "soft_laws.py").write_text(absolute)
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
