"""The files of the folder examples as plugins: nothing is put into the package."""

from __future__ import annotations

import shutil

import pytest
from helpers.pages import PLUGINS, SPIN

from pfem_petsc import registry
from pfem_petsc.case import toml


@pytest.fixture
def plugin_files(comm, shared_tmp_path):
    """A folder with the examples' files."""
    folder = shared_tmp_path / "added"
    if comm.rank == 0:
        folder.mkdir()
        for name, code in {**PLUGINS, "polygon_spin.toml": SPIN}.items():
            (folder / name).write_text(code)
    comm.Barrier()
    return folder


@pytest.fixture
def examples(monkeypatch, comm, plugin_files, own_registry):
    """The examples' modules and their case, found by name."""
    cases = plugin_files / "cases"
    if comm.rank == 0:
        shutil.copytree(toml.FOLDER, cases)
        shutil.copy(plugin_files / "polygon_spin.toml", cases)
    comm.Barrier()
    monkeypatch.setattr(toml, "FOLDER", cases)
    for path in sorted(plugin_files.glob("*.py")):
        registry.add_plugin(path)
