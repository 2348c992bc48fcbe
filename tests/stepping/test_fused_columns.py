"""Fused steps of lattices by columns of bars: bitwise identical to single steps."""

from __future__ import annotations

import numpy as np
import pytest
from stepping.test_fused_steps import DAMPED, FLOOR, LATTICE, PLASTIC, case, made

from pfem_petsc import open_result
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.mechanics.runs import NO_BAR, make_columns
from pfem_petsc.stepping import batches as fused_steps

YIELD = {"yield_stress": 50e6, "isotropic_hardening": 1e9}
BLOCK = {"generator": "lattice", "kind": "cubic", "pitch": 0.01}
CASES = {
    "yielding on a wall": {
        "mesh": BLOCK | {"cells": [12, 9, 10]},
        "material": {"it": DAMPED["it"] | PLASTIC},
        "wall": [FLOOR],
    },
    "block": {"mesh": BLOCK | {"cells": [9, 10, 11]}},
    "shortened bars": {
        "mesh": BLOCK | {"cells": [9, 10, 11]},
        "load": [{"node_set": "corner", "force": [1e5, 3e3, 0.0]}],  # by up to 17 %
    },
    "missing bars": {"mesh": BLOCK | {"cells": [16, 17, 16], "missing": 0.02, "seed": 4}},
    "moving window": {"mesh": BLOCK | {"cells": [45, 12, 12]}},
    "held on a wall": {
        "mesh": BLOCK | {"cells": [11, 9, 10]},
        "material": DAMPED,
        "support": [{"node_set": "foot", "fix": "x"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "wall": [FLOOR],
    },
    "viscoplastic": {
        "mesh": BLOCK | {"cells": [9, 10, 11]},
        "material": {
            "it": LATTICE["material"]["it"]
            | YIELD
            | {"law": "cowper_symonds", "rate_reference": 40.4, "rate_exponent": 5.0}
        },
        "support": [{"node_set": "foot", "fix": "z"}],
    },
    "viscous": {
        "mesh": BLOCK | {"cells": [10, 9, 11]},
        "material": {"it": LATTICE["material"]["it"] | {"stiffness_damping": 2e-8}},
        "wall": [FLOOR],
    },
    "struts": {
        "mesh": BLOCK | {"cells": [9, 11, 10]},
        "material": {"it": LATTICE["material"]["it"] | {"law": "strut", "yield_stress": 1e6}},
        "section": {"it": {"area": 1e-6, "shape": "round", "material": "it"}},
        "support": [{"node_set": "foot", "fix": "z"}],
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


COMPILED_HERE = ("viscoplastic", "viscous", "struts")  # their loops take 15 s each to compile
NAMES = [pytest.param(name, marks=pytest.mark.thorough) if name in COMPILED_HERE else name for name in CASES]


@pytest.mark.parallel
@pytest.mark.parametrize("name", NAMES)
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
    kept = [simulation.model.bars.blocks[0].history for simulation in (one, many) if simulation.model.bars.blocks]
    for first, second in zip(kept[::2], kept[1::2], strict=True):
        np.testing.assert_array_equal(first, second)
    changed = sum(np.ptp(history[0]) > 0.0 for history in kept if history.size)
    assert comm.allreduce(changed) > 0 or "material" not in CASES[name] or name == "held on a wall"


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
