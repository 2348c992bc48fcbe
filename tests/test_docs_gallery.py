"""docs/gallery.md has every built-in case, with a picture, its cost and the number that its test compares."""

from __future__ import annotations

import gallery
import pytest
from mpi4py import MPI
from PIL import Image

from pfem_petsc import Simulation
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases


def test_every_case_is_an_entry():
    """The numbers: tests/cases/test_built_in_cases.py."""
    assert set(gallery.entries()) == set(built_in_cases())


def test_page_is_that_of_the_entries():
    assert gallery.PAGE.read_text() == gallery.page(), "run scripts/gallery.py"


@pytest.mark.parametrize("name", sorted(gallery.entries()))
def test_entry_is_complete(name, tmp_path):
    entry = gallery.entries()[name]
    assert {"quantity", "value", "tolerance", "reference", "bars", "steps", "seconds"} <= set(entry)
    assert entry["tolerance"] <= max(0.06 * abs(entry["value"]), 1e-12)  # a number that says something
    picture = Image.open(gallery.PICTURES / f"{name}.png").convert("L")
    assert picture.size == tuple(map(int, gallery.SIZE.split("x")))
    assert sum(picture.histogram()[:128]) > 500, "an empty picture"
    if entry["bars"] < 1000:
        with Simulation(Case.load(name), MPI.COMM_SELF, output=tmp_path, quiet=True) as simulation:
            assert simulation.model.mesh.n_bars == entry["bars"]
