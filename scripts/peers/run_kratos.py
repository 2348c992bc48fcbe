"""Kratos on the lattice: elastic trusses; usage: run_kratos.py CELLS explicit|implicit|static STEPS.

The foot is held along z; in static increments the foot is held and the top is pressed down.
"""

from __future__ import annotations

import json

import KratosMultiphysics as Kratos
import KratosMultiphysics.StructuralMechanicsApplication as Structures
import model as m
from KratosMultiphysics.StructuralMechanicsApplication import python_solvers_wrapper_structural as solvers

PART = "lattice"


def settings(mode: str, h: float) -> Kratos.Parameters:
    """Of the structural solver."""
    values = {
        "solver_type": "static" if mode == "static" else "dynamic",
        "model_part_name": PART,
        "domain_size": 3,
        "echo_level": 0,
        "rotation_dofs": False,
        "model_import_settings": {"input_type": "use_input_model_part"},
        "material_import_settings": {"materials_filename": ""},
        "time_stepping": {"time_step": h},
    }
    if mode == "explicit":
        values |= {
            "time_integration_method": "explicit",
            "scheme_type": "central_differences",
            "time_step_prediction_level": 0,
            "max_delta_time": h,
        }
    else:
        if mode == "implicit":
            values |= {"time_integration_method": "implicit", "scheme_type": "newmark"}
        values |= {
            "analysis_type": "non_linear",
            "convergence_criterion": "residual_criterion",
            "residual_relative_tolerance": 1e-6,
            "residual_absolute_tolerance": 1e-9,
            "linear_solver_settings": {"solver_type": "amgcl", "tolerance": 1e-8},
        }
    return Kratos.Parameters(json.dumps(values))


def main() -> None:
    """Run and report."""
    cells, mode, steps, _ = m.arguments()
    explicit, static = mode == "explicit", mode == "static"
    h = {"explicit": m.EXPLICIT_STEP, "implicit": m.IMPLICIT_STEP, "static": 1.0 / (steps + 1)}[mode]
    Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
    points, bars = m.truss(cells)
    solver = solvers.CreateSolverByParameters(Kratos.Model(), settings(mode, h), "OpenMP")
    solver.AddVariables()
    part = solver.main_model_part
    for node, point in enumerate(points.tolist(), start=1):
        part.CreateNewNode(node, *point)
    strut = part.CreateNewProperties(1)
    strut.SetValue(Kratos.YOUNG_MODULUS, m.YOUNG_MODULUS)
    strut.SetValue(Kratos.DENSITY, m.DENSITY)
    strut.SetValue(Kratos.POISSON_RATIO, 0.3)
    strut.SetValue(Kratos.COMPUTE_LUMPED_MASS_MATRIX, True)
    strut.SetValue(Kratos.CONSTITUTIVE_LAW, Structures.TrussConstitutiveLaw())
    strut.SetValue(Structures.CROSS_AREA, m.AREA)
    for zero in (Structures.TRUSS_PRESTRESS_PK2, Structures.RAYLEIGH_ALPHA, Structures.RAYLEIGH_BETA):
        strut.SetValue(zero, 0.0)
    for bar, ends in enumerate((bars + 1).tolist(), start=1):
        part.CreateNewElement("TrussElement3D2N", bar, ends, strut)
    solver.ImportModelPart()
    solver.PrepareModelPart()
    solver.AddDofs()
    height = points[:, 2].max()
    pressed = [node for node in part.Nodes if static and node.Z0 in (height,)]
    for node in part.Nodes:
        if static:
            if node.Z0 in (0.0, height):
                for component in (Kratos.DISPLACEMENT_X, Kratos.DISPLACEMENT_Y, Kratos.DISPLACEMENT_Z):
                    node.Fix(component)
            continue
        if node.Z0 == 0.0:
            node.Fix(Kratos.DISPLACEMENT_Z)
            continue
        for buffer in (0, 1):
            node.SetSolutionStepValue(Kratos.VELOCITY, buffer, [0.0, 0.0, m.SPEED])
    solver.Initialize()
    solver.Check()
    time = 0.0

    def step() -> float:
        nonlocal time
        time = solver.AdvanceInTime(time)
        for node in pressed:
            node.SetSolutionStepValue(Kratos.DISPLACEMENT_Z, -m.PRESSED * height * time)
        solver.InitializeSolutionStep()
        solver.Predict()
        converged = solver.SolveSolutionStep()
        solver.FinalizeSolutionStep()
        if not explicit and not converged:
            raise RuntimeError("Kratos did not converge")
        return 0.0 if explicit else float(part.ProcessInfo[Kratos.NL_ITERATION_NUMBER])

    times = m.time_steps(step, steps)
    # in static increments the top is prescribed: the node in the middle of the block's edge sags instead
    watched = m.middle(points) + 1 if static else len(points)
    top = part.Nodes[watched].GetSolutionStepValue(Kratos.DISPLACEMENT_X if static else Kratos.DISPLACEMENT_Z)
    m.report(times, len(bars), top, threads=float(Kratos.ParallelUtilities.GetNumThreads()))


main()
