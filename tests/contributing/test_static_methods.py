"""The method of a static analysis of the folder examples: equilibria at listed load factors."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pages import run
from helpers.small_models import ARCH_AREA, ARCH_YOUNG, LIMIT, arch_of
from helpers.stopped import assert_restart_is_bitwise

from pfem_petsc import open_result
from pfem_petsc.errors import InputError

FACTORS = [0.1, 0.25, 0.55, 0.6, 1.0]


def arch(folder, comm, factors):
    """The shallow arch under nine tenths of its limit load."""
    load = {"load": [{"node_set": "apex", "force": [0.0, 0.0, -0.9 * LIMIT]}]}
    static = {"method": "listed", "load_factors": factors}
    output = {"output": {"fields_every": 1, "probe": [{"name": "apex", "node_set": "apex"}]}}
    return arch_of(folder, comm, {"static": static}, **load, **output, solver={"linear": "cg"})


@pytest.mark.parallel
def test_load_factors_are_those_listed_and_each_is_an_equilibrium(examples, comm, shared_tmp_path):
    """The load of the arch whose apex is at the height z is 2 E A z (1/sqrt(1 + z^2) - 1/l0)."""
    run(arch(shared_tmp_path, comm, FACTORS), comm, shared_tmp_path / "whole")
    history = open_result(shared_tmp_path / "whole").history
    assert list(history["load_factor"]) == [0.0, *FACTORS]
    z = np.asarray(history["probe/apex/position"])[:, 0, 2]
    load = 2 * ARCH_YOUNG * ARCH_AREA * z * (1 / np.sqrt(1 + z * z) - 1 / np.hypot(1.0, 0.1))
    assert load == pytest.approx(0.9 * LIMIT * np.array([0.0, *FACTORS]), abs=1e-6 * LIMIT)


@pytest.mark.slow
@pytest.mark.parallel
def test_restart_is_bitwise(examples, comm, shared_tmp_path):
    assert_restart_is_bitwise(arch(shared_tmp_path, comm, FACTORS), comm, shared_tmp_path, 2)


def test_load_factors_that_do_not_increase_are_refused(examples, comm, shared_tmp_path):
    with pytest.raises(InputError, match="do not increase: list each load factor once"):
        arch(shared_tmp_path, comm, [0.5, 0.5])
