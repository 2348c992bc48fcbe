"""The commands and the Python of docs/meshes.md run in their order, and its formats are those of the program."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from pfem_petsc.cli import main as program
from pfem_petsc.formats import read_whole, suffixes

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "meshes.md").read_text()


def blocks(language: str) -> list[str]:
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)
    return [text for name, text in fenced if name == language]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "meshes", tmp_path / "meshes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_commands_run(folder, capfd):
    for line in "".join(blocks("sh")).splitlines():
        words = shlex.split(line)
        assert words[:3] == ["python", "-m", "pfem_petsc"]
        assert program.main(words[3:]) == 0, line
    told = capfd.readouterr()
    assert told.err == ""
    assert "nodes at the place of another  4" in told.out and "This case can run." in told.out
    assert (folder / "tower.png").stat().st_size > 5000
    for name in ("block.3mf", "block.msh"):
        np.testing.assert_allclose(read_whole(folder / name).bar_fields["area"], 5e-7, rtol=1e-15)


def test_python_runs(folder, capfd):
    (code,) = blocks("python")
    names: dict = {}
    exec(code, names)
    assert "4 nodes merged" in capfd.readouterr().out
    assert names["case"].material["Steel"].young_modulus == pytest.approx(2.1e11)
    assert names["case"].mesh.truss.n_bars == 26


def test_tables_are_read(folder):
    nodes, bars = blocks("")
    (folder / "a_nodes.csv").write_text(nodes)
    (folder / "a_bars.csv").write_text(bars)
    mesh = read_whole(folder / "a_bars.csv")
    assert mesh.bars.tolist() == [[0, 2], [1, 2], [0, 1]] and mesh.bar_fields["area"].tolist() == [1e-4, 1e-4, 5e-5]
    assert {name: list(members) for name, members in mesh.node_groups.items()} == {
        "feet": [0, 1],
        "top": [2],
        "loaded": [2],
    }


def test_table_of_formats():
    rows = re.findall(r"^\| [^|]+ \| ([^|]+) \| ([^|]+) \| ([^|]+) \|", TEXT, flags=re.MULTILINE)
    rows = [row for row in rows if row[0].startswith("`")]
    read = {"." + suffix for names, how, _ in rows if how != "no" for suffix in re.findall(r"\.(\w+)`", names)}
    written = {"." + suffix for names, _, how in rows if how != "no" for suffix in re.findall(r"\.(\w+)`", names)}
    assert (read, written) == (set(suffixes("read", "read_on")), set(suffixes("write")))


def test_actions_of_the_verb():
    named = set(re.findall(r"^\| `(\w+) ", TEXT.partition("## The verb")[2], flags=re.MULTILINE))
    parser, _ = program.make_parser()
    verb = parser._subparsers._group_actions[0].choices["mesh"]
    assert named == set(verb._subparsers._group_actions[0].choices)
