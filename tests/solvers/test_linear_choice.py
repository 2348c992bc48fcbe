"""Choice of the linear solver by case, size of the model and step; a restart keeps it."""

import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.solvers.linear import Demand, choose_linear

BIG = 30_000


@pytest.mark.parametrize(
    "wishes, krylov, preconditioner, matrix_free, lagged",
    [
        ({"unknowns": 500, "step_ratio": 1e4}, "preonly", "lu", False, False),
        ({"step_ratio": 30.0}, "cg", "jacobi", True, False),
        ({"step_ratio": 31.0}, "cg", "gamg", True, True),
        ({"step_ratio": 31.0, "steps": 9}, "cg", "jacobi", True, False),
        ({"step_ratio": 1e4, "impact": True}, "cg", "jacobi", True, False),
        ({"request": "cg", "step_ratio": 1e4}, "cg", "jacobi", True, False),
        ({"request": "gamg"}, "cg", "gamg", True, True),
        ({"request": "gamg", "operator": "assembled"}, "cg", "gamg", False, True),
        ({"block": True, "step_ratio": 10.0}, "cg", "jacobi", True, False),
        ({"block": True, "step_ratio": 11.0}, "cg", "multigrid", True, True),
        ({"block": True, "step_ratio": 11.0, "steps": 1}, "cg", "multigrid", True, True),
        ({"block": True, "step_ratio": 1e4, "impact": True}, "cg", "jacobi", True, False),
        ({"block": True, "step_ratio": 51.0, "operator": "assembled"}, "cg", "gamg", False, True),
        ({"request": "multigrid"}, "cg", "multigrid", True, True),
        ({"request": "mumps"}, "preonly", "mumps", False, False),
        ({"request": "mumps", "unknowns": 400}, "preonly", "lu", False, False),
        ({"request": "mumps", "operator": "matrix_free"}, "cg", "mumps", True, True),
        ({"operator": "assembled", "step_ratio": 5.0}, "cg", "pbjacobi", False, False),
        ({"operator": "assembled", "step_ratio": 50.0}, "cg", "icc", False, False),
        ({"operator": "assembled", "step_ratio": 51.0}, "cg", "gamg", False, True),
        ({"symmetric": False, "step_ratio": 50.0}, "gmres", "ilu", False, False),
        ({"symmetric": False, "step_ratio": 51.0}, "gmres", "gamg", False, True),
    ],
    ids=str,
)
def test_choices(wishes, krylov, preconditioner, matrix_free, lagged):
    wishes = dict(wishes)
    request, operator = (wishes.pop(key, "auto") for key in ("request", "operator"))
    choice = choose_linear(request, operator, Demand(**{"unknowns": BIG, "step_ratio": 1.0, **wishes}))
    assert (choice.krylov, choice.preconditioner, choice.matrix_free) == (krylov, preconditioner, matrix_free)
    assert choice.lagged == lagged


def test_no_operator_without_matrix_for_unsymmetric_schemes():
    with pytest.raises(InputError, match="this integrator needs a matrix"):
        choose_linear("auto", "matrix_free", Demand(BIG, 1.0, symmetric=False))


@pytest.mark.slow
def test_a_restart_keeps_the_choice_unless_the_case_asks_for_another(comm, tmp_path):
    """Fewer steps would choose Jacobi: the choice is in the checkpoint."""

    def run(steps, solver, folder="run", **options):
        case = {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [6, 6, 2], "pitch": 0.01},
            "material": {"m": {"young_modulus": 110e9, "density": 4500.0}},
            "section": {"s": {"area": 1e-6, "material": "m"}},
            "initial": {"velocity": [0.0, 0.0, 0.0], "angular_velocity": [5.0, 0.0, 0.0]},
            "time": {"integrator": "newmark", "step": 1e-4, "end": steps * 1e-4},
            "output": {"fields_every": 0, "fields": [], "checkpoint_every": 4},
            "solver": solver,
        }
        simulation = Simulation(Case.from_dict(case), comm, output=tmp_path / folder, quiet=True, **options)
        return simulation, simulation.plan.linear

    first, chosen = run(12, {})
    assert chosen.preconditioner == "gamg" and "explicit limit" in chosen.why
    for done in first:
        if done.step == 5:
            break
    assert run(8, {}, "other")[1].preconditioner == "jacobi"
    again, kept = run(8, {}, restart=True)
    assert kept == chosen
    assert again.run() == 0
    assert run(8, {"linear": "cg"}, restart=first.folder / "checkpoint.h5")[1].preconditioner == "jacobi"
