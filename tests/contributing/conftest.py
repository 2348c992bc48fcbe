"""The package with the examples of CONTRIBUTING.md in its folders."""

from __future__ import annotations

import importlib
import shutil
import sys

import pytest
from helpers.contributed import EXAMPLES, PACKAGES

from pfem_petsc.case import toml


@pytest.fixture
def examples(monkeypatch, comm, shared_tmp_path):
    """The package with the examples' files in its folders."""
    root = shared_tmp_path / "added"
    if comm.rank == 0:
        shutil.copytree(toml.FOLDER, root / "cases")
        for path, code in EXAMPLES.items():
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_text(code)
    comm.Barrier()
    importlib.invalidate_caches()
    for name in PACKAGES:
        package = importlib.import_module(f"pfem_petsc.{name}")
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(root / name.replace(".", "/"))])
    monkeypatch.setattr(toml, "FOLDER", root / "cases")
    yield
    for path in EXAMPLES:
        module = "pfem_petsc." + path.removesuffix(".py").replace("/", ".")
        if module in sys.modules:
            del sys.modules[module]
            parent, _, name = module.rpartition(".")
            delattr(sys.modules[parent], name)
