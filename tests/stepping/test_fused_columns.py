"""Fused steps of lattices by columns of bars: bitwise identical to single steps."""

from __future__ import annotations

import numpy as np
import pytest
from stepping.test_fused_steps import DAMPED, FLOOR, case, made

from pfem_petsc import open_result
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.mechanics.columns import NO_BAR, make_columns
from pfem_petsc.stepping import fused_steps

BLOCK = {"generator": "lattice", "kind": "cubic", "pitch": 0.01}
CASES = {
    "block": {"mesh": BLOCK | {"cells": [9, 10, 11]}},
    "missing bars": {"mesh": BLOCK | {"cells": [16, 17, 16], "missing": 0.02, "seed": 4}},
    "moving window": {"mesh": BLOCK | {"cells": [45, 12, 12]}},
    "held on a wall": {
        "mesh": BLOCK | {"cells": [11, 9, 10]},
        "material": DAMPED,
        "support": [{"node_set": "foot", "fix": "x"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "wall": [FLOOR],
    },
    "own areas": {
        "mesh": BLOCK | {"cells": [10, 11, 9], "bar_fields": {"area": "1e-6*(1 + 20*x)"}},
        "section": {"it": {"area_field": "area", "material": "it"}},
        "support": [{"node_set": "foot", "fix": "z"}],
    },
}


@pytest.fixture
def groups(monkeypatch):
    """Return a list that receives the number of groups of columns of each batch, and of its gaps."""
    found = []

    def note(*given):
        columns = make_columns(*given)
        found.append((len(columns.heads), int((columns.rest == NO_BAR).sum())))
        return columns

    monkeypatch.setattr(fused_steps, "make_columns", note)
    return found


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_steps_by_columns_are_the_single_steps(name, comm, groups, shared_tmp_path):
    given = case(CASES[name], end=2.2e-5)
    one, count = made(given, shared_tmp_path / "one", False)
    many, fewer = made(given, shared_tmp_path / "many", True)
    assert count == 110 and fewer < 60
    assert all(number and gaps for number, gaps in groups) and len(groups) >= (comm.size == 1)
    first, second = open_result(shared_tmp_path / "one"), open_result(shared_tmp_path / "many")
    for column in first.history:
        np.testing.assert_array_equal(first.history[column], second.history[column], err_msg=column)
    for what in ("x", "v", "a", "f", "contact", "support"):
        np.testing.assert_array_equal(getattr(one.state, what), getattr(many.state, what), err_msg=what)


def test_a_bar_that_collapses_has_its_number(groups, tmp_path):
    """Columns between the rows of the lattice do not count."""
    changes = CASES["block"] | {"load": [{"node_set": "corner", "force": [1e7, 1e5, 0.0]}]}
    given = case(changes, end=4e-5)
    told = []
    for together in (False, True):
        with pytest.raises(SimulationFailure) as failure:
            made(given, tmp_path / str(together), together)
        told.append(str(failure.value))
    assert told[0] == told[1] and "bar" in told[0]
    assert groups
