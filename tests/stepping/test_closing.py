"""A simulation as a context manager, and functions called after steps."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError, SimulationFailure


def simulate(comm, folder, *overrides, **options):
    case = Case.load("rod_impact", ["time.end=0.2", *overrides])
    return Simulation(case, comm, output=folder / "out", quiet=True, **options)


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_closed_simulation(comm, shared_tmp_path, integrator):
    with simulate(comm, shared_tmp_path, f"time.integrator={integrator}") as simulation:
        assert simulation.run() == 0
    simulation.close()
    # what was there can still be looked at
    assert simulation.row["step"] == simulation.state.step == 20
    uses = (simulation.run, simulation.start, simulation.summary, simulation.inspect, lambda: next(iter(simulation)))
    for use in (*uses, lambda: simulation.gather(simulation.state.v), lambda: simulation.on_step(print)):
        with pytest.raises(InputError, match="this simulation was closed"):
            use()


@pytest.mark.parallel
def test_closed_before_its_end(comm, shared_tmp_path):
    """The rows so far are in the results, whoever still holds the iteration."""
    with simulate(comm, shared_tmp_path) as simulation:
        steps = iter(simulation)
        for _ in range(7):
            next(steps)
    with pytest.raises(InputError, match="this simulation was closed"):
        next(steps)
    if comm.rank == 0:
        with open_result(shared_tmp_path / "out") as result:
            np.testing.assert_array_equal(result.history["step"], range(8))
    comm.Barrier()
    with simulate(comm, shared_tmp_path) as again:
        assert again.run() == 0


def test_closed_without_a_step(comm, shared_tmp_path):
    with simulate(comm, shared_tmp_path):
        pass
    with simulate(comm, shared_tmp_path, check_only=True) as simulation:
        assert "nodes" in simulation.summary()
    assert not (shared_tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parallel
def test_state_of_a_restart(comm, shared_tmp_path):
    """It is there before the first step."""
    keys = ["output.checkpoint_every=8"]
    with simulate(comm, shared_tmp_path, *keys) as simulation:
        simulation.run()
        position, time = simulation.state.position.copy(), simulation.state.time
    with simulate(comm, shared_tmp_path, *keys, "time.end=0.25", restart=True) as simulation:
        assert (simulation.state.step, simulation.state.time) == (20, time)
        np.testing.assert_array_equal(simulation.state.position, position)
        assert next(iter(simulation)).step == 21


def test_exception_within(tmp_path):
    """Results, signals and folder are free afterwards, and the exception is told."""
    from mpi4py import MPI

    with pytest.raises(ZeroDivisionError), simulate(MPI.COMM_SELF, tmp_path) as simulation:
        for step in simulation:
            if step.step == 5:
                raise ZeroDivisionError
    assert not (tmp_path / "out.lock").exists()
    with open_result(tmp_path / "out") as result:
        np.testing.assert_array_equal(result.history["step"], range(6))


@pytest.mark.parallel
def test_functions_after_steps(comm, shared_tmp_path):
    """Also where the steps between are made together."""
    calls = []
    with simulate(comm, shared_tmp_path, "output.fields_every=0") as simulation:
        simulation.on_step(lambda step: calls.append(("b", step.step, simulation.state.step)), every=7)
        simulation.on_step(lambda step: calls.append(("a", step.step, step.row["step"])), every=14)
        for every in (0, 2.0, True):
            with pytest.raises(InputError, match="on_step: every"):
                simulation.on_step(print, every=every)
        for _ in simulation.batches():
            pass
    assert calls == [("b", 7, 7), ("b", 14, 14), ("a", 14, 14)]


@pytest.mark.parallel
@pytest.mark.parametrize("error", [ValueError("no node"), KeyboardInterrupt("no node"), SimulationFailure("no node")])
@pytest.mark.parametrize("everywhere", [False, True])
def test_exception_of_a_function_after_steps(comm, shared_tmp_path, error, everywhere):
    """All ranks end; those without an exception are told of it."""

    def fail(step):
        if everywhere or comm.rank == comm.size - 1:
            raise error

    own = everywhere or comm.size == 1 or isinstance(error, SimulationFailure)
    told = rf"step 5: on_step: .*{type(error).__name__}: no node .*, line \d+.* on rank {comm.size - 1}"
    text = "no node" if own else told
    with pytest.raises(type(error) if own else SimulationFailure, match=text), simulate(comm, shared_tmp_path) as one:
        one.on_step(fail, every=5)
        one.run()
    del one
    comm.Barrier()
    assert everywhere or not (shared_tmp_path / "out.lock").exists()
    if comm.rank == 0:
        with open_result(shared_tmp_path / "out") as result:
            assert everywhere or result.history["step"][-1] == 5
