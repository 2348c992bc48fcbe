"""Several runs in one folder at once."""

import random

import pytest
from helpers.kills import LATER, play, shared_words

from pfem_petsc import Case, Simulation
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError


@pytest.mark.thorough
@pytest.mark.slow
def test_three_starts_and_two_restarts(tmp_path, capsys):
    """One run of those that start at once succeeds, the others are refused; restarts change nothing of its results."""
    assert main(shared_words(tmp_path / "alone", LATER)) == 0
    with capsys.disabled():  # messages of forks are read from their stderr
        for each in range(2):
            play(tmp_path / f"round{each}", tmp_path / "alone" / "result.vtkhdf", random.Random(each))


@pytest.mark.parametrize("more", [[], ["--restart"]])
def test_folder_of_a_run_that_goes_on_is_left_alone(tmp_path, capsys, more):
    """Neither moved aside nor continued; a run that was not closed gives the folder back when it is gone."""
    folder = tmp_path / "out"
    words = ["rod_impact", "-o", str(folder), "--quiet", "--set", "time.end=0.1", "output.checkpoint_every=2"]
    simulation = Simulation(Case.load("rod_impact", words[5:]), output=folder, quiet=True)
    steps = iter(simulation)
    for _ in range(5):
        next(steps)
    names = sorted(path.name for path in folder.iterdir())
    assert main([*words, *more]) == 2
    assert "another run is writing into this folder" in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == names
    assert sum(1 for _ in steps) == 5
    assert main([*words, "--restart"]) == 0


@pytest.mark.parallel
def test_all_ranks_are_refused(comm, shared_tmp_path):
    folder = shared_tmp_path / "out"
    case = Case.load("rod_impact", ["time.end=0.05"])
    simulation = Simulation(case, comm, output=folder, quiet=True)
    other = Simulation(case, comm, output=folder, quiet=True)
    simulation.start()
    with pytest.raises(InputError, match="another run is writing"):
        Simulation(case, comm, output=folder, quiet=True)
    with pytest.raises(InputError, match="another run is writing"):
        other.run()
    assert simulation.run() == 0
    with Simulation(case, comm, output=folder, quiet=True) as third:
        assert third.run() == 0


@pytest.mark.slow
def test_checkpoint_that_is_replaced_while_it_is_read(tmp_path):
    """Header and arrays are those of one file, whatever has its name by then."""
    from mpi4py import MPI

    from pfem_petsc.output.checkpoint import Checkpoint

    folder = tmp_path / "out"
    words = ["rod_impact", "-o", str(folder), "--quiet", "--set", "output.checkpoint_every=5"]
    assert main([*words, "time.end=0.1"]) == 0
    comm = MPI.COMM_SELF
    file = Checkpoint(folder / "checkpoint.h5", comm)
    simulation = Simulation(Case.load("rod_impact", ["time.end=0.1"]), output=tmp_path / "other", quiet=True)
    from pfem_petsc.restart import RunState

    orders = RunState(simulation.stepper).orders(file.scalars)
    wanted = file.read(orders)["x"]
    assert main([*words, "time.end=0.3", "--restart"]) == 0
    later = Checkpoint(folder / "checkpoint.h5", comm)
    assert (file.scalars["step"], later.scalars["step"]) == (10, 30)
    assert (file.read(orders)["x"] == wanted).all()
    assert (later.read(orders)["x"] != wanted).any()
    for one in (file, later):
        one.close()
