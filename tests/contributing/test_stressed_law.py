"""A law of a user with stress at zero strain: places without a bar in the loops of lattices give no force."""

import numpy as np

from pfem_petsc import Case, Simulation

LAW = """
from numba.extending import register_jitable

from pfem_petsc.mechanics.materials.base import Law, MaterialKeys


class Parameters(MaterialKeys):
    pretension: float

    def pack(self):
        return self.young_modulus, self.pretension


@register_jitable
def response(strain, rate, step, temperature, p, q):
    return p[0] * strain + p[1], p[0], q, ((0.5 * p[0] * strain + p[1]) * strain,)


LAW = Law(response, smooth=True)
"""


def test_steps_in_batches_are_those_of_the_general_stepper(own_registry, tmp_path):
    plugin = tmp_path / "pretension.py"
    plugin.write_text(LAW)
    tables = {
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [10, 9, 11], "pitch": 0.01},
        "node_set": {"foot": {"group": "bottom"}},
        "material": {"it": {"law": "pretension", "pretension": 1e8, "young_modulus": 110e9, "density": 4500.0}},
        "section": {"it": {"area": 1e-6, "material": "it"}},
        "support": [{"node_set": "foot", "fix": "xyz"}],
        "time": {"integrator": "central_differences", "step": 2e-7, "end": 4e-6},
        "output": {"fields_every": 0},
    }
    case, found = Case.from_dict(tables, plugins=[plugin]), []
    for how in ("batches", "general"):
        with Simulation(case, output=tmp_path / how, quiet=True) as run:
            if how == "general":
                run.external_force(lambda time, state: np.zeros_like(state.v))
            assert len(list(run.batches())) < 20 or how == "general"
            found.append((run.state.f.copy(), run.stepper.energy.total))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=0, atol=1e-9 * np.abs(found[1][0]).max())
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-9)
