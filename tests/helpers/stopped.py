"""Cases that are stopped at a step and continued."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from helpers.kills import differences
from helpers.runs import run
from pfem_petsc import Case, Simulation
from pfem_petsc.errors import EarlyStop
from pfem_petsc.output.result import open_result

SHORT = ("time.end=1.6", "output.fields_every=7")
LATTICE = ("mesh.cells=[3,3,3]", "time.end=1.2e-4", "time.step=1e-6")
TWO_RODS = (
    "mesh={generator='two_rods', length=1.0, elements=10, gap=0.05}",
    "node_set={tip={group='first_end'}, other={group='second_start'}, target={box=[[1.04, -1, -1], [3, 1, 1]]}}",
    "initial={velocity=[0.5, 0.0, 0.0], on=[{node_set='target', velocity=[0.0, 0.0, 0.0]}]}",
    "wall=[]",
    "contact_pair=[{name='faces', first='tip', second='other', direction=[1.0, 0.0, 0.0]}]",
)
LAGGED = ("mesh.cells=[4,4,4]", "time.end=5e-5", "time.step=1e-6")
ROWS = "[[0, 0, 0, 0], [0.02, 1e-3, 0, 0], [0.06, 0, 0, 2e-3], [0.1, 0, 0, 0]]"
MOVED = f"support=[{{node_set='hinge', fix='xyz', motion={ROWS}}}]"
CASES = {
    "central differences": ("rod_impact", SHORT),
    "consistent mass": ("rod_impact", (*SHORT, "time.mass=consistent")),
    "houbolt": ("rod_impact", (*SHORT, "time.integrator=houbolt")),
    "newmark": ("rod_impact", (*SHORT, "time.integrator=newmark")),
    "wilson": ("rod_impact", (*SHORT, "time.integrator=wilson", "time.theta=1.5")),
    "chung_lee": ("rod_impact", (*SHORT, "time.integrator=chung_lee")),
    "hulbert_chung": ("rod_impact", (*SHORT, "time.integrator=hulbert_chung")),
    "souza_moura": ("rod_impact", (*SHORT, "time.integrator=souza_moura")),
    "noh_bathe": ("rod_impact", (*SHORT, "time.integrator=noh_bathe")),
    "generalized_alpha": ("rod_impact", (*SHORT, "time.integrator=generalized_alpha")),
    "bathe": ("rod_impact", (*SHORT, "time.integrator=bathe")),
    "hht_alpha": ("rod_impact", (*SHORT, "time.integrator=hht_alpha", "time.alpha=-0.2", "contact.treatment=stick")),
    "lagged multigrid": (
        "lattice_drop",
        (*LAGGED, "time.integrator=newmark", "solver.linear=gamg", "solver.operator=matrix_free"),
    ),
    "multigrid on a background grid": (
        "lattice_drop",
        (*LAGGED, "time.integrator=newmark", "solver.linear=multigrid"),
    ),
    "lagged multigrid, assembled": (
        "lattice_drop",
        (*LAGGED, "time.integrator=energy_momentum", "solver.linear=gamg"),
    ),
    "lagged factorisation": (
        "rod_impact",
        (*SHORT, "time.integrator=newmark", "solver.linear=mumps", "solver.operator=matrix_free"),
    ),
    "energy_momentum": ("rod_impact", (*SHORT, "time.integrator=energy_momentum")),
    "stick": ("rod_impact", (*SHORT, "time.integrator=newmark", "contact.treatment=stick")),
    "conserving": ("rod_impact", (*SHORT, "time.integrator=newmark", "contact.treatment=conserving")),
    "mass redistribution": ("rod_impact", (*SHORT, "contact.treatment=mass_redistribution")),
    "pairs": ("rod_impact", (*SHORT, *TWO_RODS)),
    # MUMPS, which small models take on several ranks, repeats to rounding only
    "pairs, implicit": ("rod_impact", (*SHORT, *TWO_RODS, "time.integrator=generalized_alpha", "solver.linear=cg")),
    "wall with mass": ("rod_impact", (*SHORT, "wall.0.mass=0.5", "wall.0.velocity=[-0.1,0,0]")),
    "wall with mass that rebounds": (
        "rod_impact",
        (*SHORT, "wall.0.mass=0.5", "wall.0.velocity=[-0.1,0,0]", "wall.0.restitution=0.5"),
    ),
    # it ends where nodes were in the mesh
    "heavy wall": ("rod_impact", (*SHORT, "wall.0.mass=5", "wall.0.velocity=[-0.2,0,0]")),
    "wall with mass, implicit": (
        "rod_impact",
        (*SHORT, "wall.0.mass=0.5", "wall.0.velocity=[-0.1,0,0]", "time.integrator=generalized_alpha"),
    ),
    "sparse history": ("rod_impact", (*SHORT, "output.history_every=9")),
    "plastic, explicit": ("bar_collision_plastic", ("time.end=8e-5",)),
    "plastic, implicit": ("bar_collision_plastic", ("time.end=8e-5", "time.integrator=newmark")),
    "plastic lattice": ("lattice_drop", LATTICE),
    "supported, multistep": ("pendulum", ("time.end=0.15", "time.integrator=houbolt")),
    "moved, explicit": ("pendulum", ("time.end=0.15", MOVED)),
    "moved, multistep": ("pendulum", ("time.end=0.15", MOVED, "time.integrator=houbolt")),
    "moved, beyond the step": ("pendulum", ("time.end=0.15", MOVED, "time.integrator=wilson", "time.theta=1.6")),
    "heated": (
        "pendulum",
        ("time.end=0.15", "material.default.thermal_expansion=1e-5")
        + ("temperature=[{table = [[0.0, 0.0], [0.1, 50.0]]}]", "time.integrator=newmark"),
    ),
}


def request_stop(simulation, last):
    """Let a run be asked to stop after a step, as by a signal."""

    def stop(step):
        if step.step == last and simulation.comm.rank == simulation.comm.size - 1:
            simulation._synchroniser.stop._signal = 15

    simulation.on_step(stop, every=last)


def simulate(case, overrides, folder, comm, stop_after=None, **options):
    """Run, to the end or to a stop; gives the number of the last step."""
    simulation = Simulation(Case.load(case, overrides), comm, output=folder, quiet=True, **options)
    if stop_after is None:
        assert simulation.run() == 0
    else:
        request_stop(simulation, stop_after)
        with pytest.raises(EarlyStop, match="SIGTERM"):
            simulation.run()
    return simulation.state.step


def everywhere(comm, function, *arguments):
    """What a function gives on rank 0."""
    return comm.bcast(function(*arguments) if comm.rank == 0 else None)


ROD = ["rod_impact", "--quiet", "--set", "output.checkpoint_every=20"]


def rod(folder, *more, end=0.5):
    return [*ROD, f"time.end={end}", "-o", str(folder), *more]


def steps(folder):
    with open_result(folder) as result:
        return result.history["step"], result.steps


ITERATIONS = ("history/linear_iterations", "history/newton_iterations")


def assert_restart_is_bitwise(case, comm, folder, *stops, allowed=0.0):
    """Runs that end after each of these steps and go on have the results of one that does not end, to the last bit.

    ``allowed`` : relative differences, where PETSc adds parts of other ranks in the order in which they come; sums of
    bytes, the imbalance, which is rounding itself, and numbers of iterations, of which rounding decides the last, are
    then left out. Returns the history, the same on all ranks. Collective.
    """
    history = run(case, folder / "whole", comm)
    for at in stops:
        part = folder / f"stopped at {at}"
        with Simulation(case, comm, output=part, quiet=True) as first:
            for made in first:
                if made.step == at:
                    first.outputs.checkpointing.observe()
                    break
        with Simulation(case, comm, output=part, quiet=True, restart=True) as rest:
            assert [made.step for made in rest][0] == at + 1
        apart = everywhere(comm, differences, folder / "whole/result.vtkhdf", part / "result.vtkhdf")
        rounding = ("checks/", "history/energy_imbalance", *ITERATIONS) if allowed else ()
        assert all(size <= allowed or name.startswith(rounding) for name, size in apart.items()), apart
    return history


def assert_as_on_one_rank(history, case, comm, folder, *names, within=1e-9):
    """Columns of a history are those of a run on one rank, but for a part of their largest values. Collective."""
    if comm.rank == 0:
        alone = run(case, folder / "alone", MPI.COMM_SELF)
        for name in names:
            atol = within * np.abs(alone[name]).max()
            np.testing.assert_allclose(history[name], alone[name], rtol=0.0, atol=atol, err_msg=name)
