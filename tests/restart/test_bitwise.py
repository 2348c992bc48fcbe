"""A run continued from a checkpoint gives what it would have given: bit for bit on as many ranks, nearly on others."""

import numpy as np
import pytest
from helpers.kills import differences
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import EarlyStop
from pfem_petsc.recording.history import History
from pfem_petsc.recording.snapshots import Snapshots

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
    "generalized_alpha": ("rod_impact", (*SHORT, "time.integrator=generalized_alpha")),
    "lagged multigrid": (
        "lattice_drop",
        (*LAGGED, "time.integrator=newmark", "solver.linear=gamg", "solver.operator=matrix_free"),
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


class Stopped(Simulation):
    """A run that is asked to stop after a step, as by a signal."""

    last = -1

    def _advance(self):
        result = super()._advance()
        if result.step == self.last and self.comm.rank == self.comm.size - 1:
            self._stop._signal = 15
        return result


def simulate(case, overrides, folder, comm, stop_after=None, **options):
    """Run, to the end or to a stop; gives the number of the last step."""
    simulation = Stopped(Case.load(case, overrides), comm, output=folder, quiet=True, **options)
    if stop_after is None:
        assert simulation.run() == 0
    else:
        simulation.last = stop_after
        with pytest.raises(EarlyStop, match="SIGTERM"):
            simulation.run()
    return simulation.state.step


def everywhere(comm, function, *arguments):
    """What a function gives on rank 0."""
    return comm.bcast(function(*arguments) if comm.rank == 0 else None)


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_restart_on_as_many_ranks_is_bitwise(comm, shared_tmp_path, name):
    case, overrides = CASES[name]
    folders = shared_tmp_path / "whole", shared_tmp_path / "stopped"
    simulate(case, overrides, folders[0], comm)
    stopped = simulate(case, overrides, folders[1], comm, stop_after=33)
    assert 33 <= stopped < 150
    # again, between rows of the history and snapshots
    assert simulate(case, overrides, folders[1], comm, stop_after=stopped + 5, restart=True) > stopped
    simulate(case, overrides, folders[1], comm, restart=True)
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}


ROD = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
    "material": {"m": {"young_modulus": 1e6, "density": 1000.0, "damping": 1e4}},
    "section": {"s": {"area": 1.0, "material": "m"}},
    "initial": {"velocity": [0.1, 0.0, 0.0]},
    "time": {"integrator": "newmark", "step": 0.04, "end": 4.0},
}


def test_motion_that_has_come_to_rest_is_not_taken_for_unstable_after_a_restart(tmp_path):
    """What energies are compared with is that of the start; nothing of it is left."""
    folders = tmp_path / "whole", tmp_path / "stopped"
    for folder, ends in zip(folders, ((4.0,), (2.0, 4.0)), strict=True):
        for end in ends:
            data = {**ROD, "time": {**ROD["time"], "end": end}, "output": {"checkpoint_every": 10}}
            run = Simulation(Case.from_dict(data), output=folder, quiet=True, restart=end != ends[0])
            assert run.run() == 0
    assert differences(*(folder / "result.vtkhdf" for folder in folders)) == {}


def _watched(simulation):
    history = simulation.outputs.history
    return history.blow_up.kept(), history.recorder.energy_scale, simulation.model.pairs.force.copy()


@pytest.mark.parallel
def test_all_that_is_looked_at_in_later_steps_is_put_back(comm, shared_tmp_path):
    """Also what only messages and rows show: the watch, the largest energy, the forces of pairs."""
    overrides = (*SHORT, *TWO_RODS, "output.checkpoint_every=10")
    found = []
    for end in (0.3, 0.6):
        case = Case.load("rod_impact", [*overrides, f"time.end={end}"])
        simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True, restart=end > 0.3)
        simulation.start()
        found.append(_watched(simulation))
        while simulation.state.step < simulation.plan.steps:
            simulation._advance()
        found.append(_watched(simulation))
        simulation.close()
    (_, before, after, _) = found
    assert before[:2] == after[:2]
    assert before[0]["rows"] == 31
    np.testing.assert_array_equal(before[2], after[2])
    assert before[2].any()


EXTENDED = {
    "central differences": ("rod_impact", ("time.step=0.01",), 0.01),
    "newmark": ("rod_impact", ("time.step=0.01", "time.integrator=newmark"), 0.01),
    "houbolt": ("pendulum", ("time.step=1e-3", "time.integrator=houbolt"), 1e-3),
    "plastic lattice": ("lattice_drop", ("mesh.cells=[3,3,3]", "time.step=1e-6"), 1e-6),
}
SPARSE = ("output.history_every=4", "output.fields_every=6", "output.checkpoint_every=25")


@pytest.mark.parallel
@pytest.mark.parametrize(
    ("name", "end"), [("central differences", 33), ("newmark", 42), ("houbolt", 36), ("plastic lattice", 33)]
)
def test_finished_run_with_a_later_end_is_the_run_that_had_it_from_the_start(comm, shared_tmp_path, name, end):
    """The former end is off the schedule of rows, of snapshots, or both: what was written for it goes."""
    case, overrides, step = EXTENDED[name]
    folders = shared_tmp_path / "whole", shared_tmp_path / "longer"
    overrides = (*overrides, *SPARSE)
    simulate(case, (*overrides, f"time.end={70 * step}"), folders[0], comm)
    assert simulate(case, (*overrides, f"time.end={end * step}"), folders[1], comm) == end
    assert everywhere(comm, _last_steps, folders[1]) == (end, end)
    assert simulate(case, (*overrides, f"time.end={70 * step}"), folders[1], comm, restart=True) == 70
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}


def _last_steps(folder):
    with open_result(folder) as result:
        return int(result.history["step"][-1]), int(result.steps[-1])


class Killed(Exception):  # noqa: N818
    """In place of a signal that nobody can catch."""


@pytest.mark.parallel
@pytest.mark.parametrize("lost", ["row", "snapshot"])
def test_killed_between_the_last_checkpoint_and_the_end_of_the_results(comm, shared_tmp_path, monkeypatch, lost):
    case, overrides, step = EXTENDED["newmark"]
    folders = shared_tmp_path / "whole", shared_tmp_path / "killed"
    overrides = (*overrides, *SPARSE, f"time.end={33 * step}")
    simulate(case, overrides, folders[0], comm)

    def killed(self):
        if self._stepper.state.step != 33:
            return done(self)
        if lost == "snapshot":
            self.writer.flush_history()
        raise Killed

    with monkeypatch.context() as patch:
        writer, name = (History, "record") if lost == "row" else (Snapshots, "write")
        done = getattr(writer, name)
        patch.setattr(writer, name, killed)
        simulation = Simulation(Case.load(case, overrides), comm, output=folders[1], quiet=True)
        with pytest.raises(Killed):
            simulation.run()
        simulation._finish("failed")
    assert everywhere(comm, _last_steps, folders[1]) == (32 if lost == "row" else 33, 30)
    assert simulate(case, overrides, folders[1], comm, restart=True) == 33
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}
    assert everywhere(comm, _last_steps, folders[1]) == (33, 33)


@pytest.mark.parallel
@pytest.mark.parametrize("name", ["central differences", "houbolt", "plastic lattice", "newmark"])
def test_restart_on_another_number_of_ranks(comm, shared_tmp_path, name):
    """Written by one rank, continued by all, and the other way round."""
    case, overrides = CASES[name]
    whole = shared_tmp_path / "whole"
    simulate(case, overrides, whole, comm)
    for first, then in ((MPI.COMM_SELF, comm), (comm, MPI.COMM_SELF)):
        folder = shared_tmp_path / f"stopped-{first == comm}"
        if comm.rank == 0 or first == comm:
            simulate(case, overrides, folder, first, stop_after=33)
        comm.Barrier()
        if comm.rank == 0 or then == comm:
            simulate(case, overrides, folder, then, restart=True)
        comm.Barrier()
        apart = everywhere(comm, _far, whole, folder)
        assert apart == {}


def _far(one, other):
    """Columns of the history that differ by more than 1e-10 of their largest value; energies by all energies."""
    found = {}
    with open_result(one) as a, open_result(other) as b:
        np.testing.assert_array_equal(a.history["step"], b.history["step"])
        np.testing.assert_array_equal(a.steps, b.steps)
        energy = np.abs(a.history["kinetic_energy"]).max() + np.abs(a.history["elastic_energy"]).max()
        momentum = np.abs(a.history["momentum"]).max()
        for name in a.history:
            x, y = np.asarray(a.history[name], dtype=float), np.asarray(b.history[name], dtype=float)
            scale = np.abs(x).max()
            if name.endswith(("_work", "_dissipation", "_imbalance", "_energy", "_heat")):
                scale = energy
            if name == "angular_momentum":
                scale = max(scale, momentum)
            if np.abs(x - y).max() > 1e-10 * scale:
                found[name] = (np.abs(x - y).max(), scale)
        for i in range(len(a.times)):
            if np.abs(a.positions(i) - b.positions(i)).max() > 1e-10 * np.abs(a.positions(i)).max():
                found[f"positions {i}"] = i
    return found


@pytest.mark.parallel
def test_state_comes_back_to_the_last_bit_with_nodes_elsewhere(comm, shared_tmp_path):
    """One rank writes a yielding lattice, all read it: nodal arrays and plastic strains are the same numbers."""
    case, overrides = CASES["plastic lattice"]
    folder = shared_tmp_path / "lattice"
    before = {}
    if comm.rank == 0:
        first = Stopped(Case.load(case, overrides), MPI.COMM_SELF, output=folder, quiet=True)
        first.last = 60
        with pytest.raises(EarlyStop):
            first.run()
        before = _by_number(first, MPI.COMM_SELF)
        assert np.abs(before["plastic_strain"]).max() > 1e-6
    before = comm.bcast(before)
    again = Simulation(Case.load(case, overrides), comm, output=folder, quiet=True, restart=True)
    again.start()
    after = _by_number(again, comm)
    again._finish("stopped")
    assert before.keys() == after.keys()
    for name in before:
        assert before[name].tobytes() == after[name].tobytes(), name


def _by_number(simulation, comm):
    """Nodal arrays and plastic strains in mesh numbering, checked to be equal where a bar is on two ranks."""
    mesh, state = simulation.mesh, simulation.state
    owned = mesh.n_owned
    found = {}
    arrays = {"x": state.position, "v": state.v, "a": state.a, "f": state.f[:owned], "contact": state.contact}
    for name, array in {**arrays, **state.memory}.items():
        whole = np.zeros((mesh.n_nodes, 3))
        whole[mesh.node_ids[:owned]] = array
        found[name] = comm.allreduce(whole)
    strain = simulation.model.bars.fields(state.x)["plastic_strain"]
    low, high = np.full(mesh.n_bars, np.inf), np.full(mesh.n_bars, -np.inf)
    low[mesh.bar_ids] = high[mesh.bar_ids] = strain
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    np.testing.assert_array_equal(low, high)
    found["plastic_strain"] = low
    return found
