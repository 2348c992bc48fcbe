"""Modes in files: the same on any number of ranks, checked, continued, read by ParaView's reader, drawn."""

from __future__ import annotations

import io
import shutil
import signal

import h5py
import numpy as np
import pytest
from helpers.small_models import arch_of, press
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.cli.main import main
from pfem_petsc.errors import EarlyStop, InputError
from pfem_petsc.modes import find as choice
from pfem_petsc.output.integrity import examine
from pfem_petsc.output.result import open_result
from pfem_petsc.post.motion import mode_frames
from pfem_petsc.post.render import render_modes


def run(case, folder, comm=MPI.COMM_SELF, **options):
    simulation = Simulation(case, comm, output=folder, quiet=True, **options)
    assert simulation.run() == 0
    return simulation


def block(**modes):
    return Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 2], "pitch": 0.1},
            "material": {"it": {"young_modulus": 1e9, "density": 1000.0}},
            "section": {"it": {"area": 1e-5, "material": "it"}},
            "modes": {"count": 8, **modes},
        }
    )


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_files_of_any_number_of_ranks(mass, shared_tmp_path, comm):
    run(block(mass=mass), shared_tmp_path / "all", comm)
    if comm.rank == 0:
        run(block(mass=mass), shared_tmp_path / "one")
        ours, alone = (open_result(shared_tmp_path / name) for name in ("all", "one"))
        assert examine(ours.path, deep=True) == []
        assert examine(shared_tmp_path / "all" / "modes.vtkhdf", deep=True) == []
        assert ours.modes.frequency == pytest.approx(alone.modes.frequency, rel=1e-8)
        assert ours.modes.shape == pytest.approx(alone.modes.shape, abs=1e-8 * np.abs(alone.modes.shape).max())
        steps = open_result(shared_tmp_path / "all" / "modes.vtkhdf")
        assert steps.times.tolist() == list(range(1, 9))
        assert (steps.field("displacement", 6) == ours.modes.shape[6]).all()
        assert (steps.field("frequency", 6) == ours.modes.frequency[6]).all()
        assert (steps.positions(3) == ours.positions(-1)).all()
        assert (steps.history["frequency"] == ours.modes.frequency).all()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The results of the block."""
    folder = tmp_path_factory.mktemp("block") / "out"
    run(block(), folder)
    return folder


def test_a_reader_of_paraview_sees_a_step_a_mode(finished):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(finished / "modes.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 8
    reader.SetStep(7)
    reader.Update()
    data = reader.GetOutput().GetPointData()
    assert (vtk_to_numpy(data.GetArray("displacement")) == open_result(finished).modes.shape[7]).all()


@pytest.mark.slow
def test_damage_is_found(tmp_path, finished):
    path = open_result(shutil.copytree(finished, tmp_path / "out")).path
    with h5py.File(path, "r+") as file:
        file["modes/shape"][2, 5, 1] += 1e-12
        file["modes/frequency"][7] *= 1.0 + 1e-12
    assert examine(path, deep=True) == [f"mode {k} does not match its checksum" for k in (3, 8)]


def test_results_without_modes_or_frequencies(tmp_path):
    run(arch_of(tmp_path, MPI.COMM_SELF, press(0.5)), tmp_path / "none")
    assert open_result(tmp_path / "none").n_modes == 0
    with pytest.raises(InputError, match="has no modes"):
        _ = open_result(tmp_path / "none").modes
    run(arch_of(tmp_path, MPI.COMM_SELF, press(0.5), modes={"kind": "buckling"}), tmp_path / "out")
    modes = open_result(tmp_path / "out").modes
    assert len(modes) == 1 and modes.label(0).startswith("mode 1: load factor ")
    with pytest.raises(InputError, match="modes of buckling have no frequency"):
        _ = modes.frequency


@pytest.mark.slow
def test_restart_of_a_finished_run(tmp_path):
    """With its modes: nothing; with others: these alone, from the checkpoint at the end; to a later end: new ones."""
    tables = press(0.5) | {"output": {"checkpoint_every": 1}}
    out = tmp_path / "out"
    run(arch_of(tmp_path, MPI.COMM_SELF, tables, modes={"count": 1}), out)
    first = open_result(out).modes.frequency
    assert run(arch_of(tmp_path, MPI.COMM_SELF, tables, modes={"count": 1}), out, restart=True).finished
    consistent = arch_of(tmp_path, MPI.COMM_SELF, tables, modes={"count": 1, "mass": "consistent"})
    again = run(consistent, out, restart=True)
    assert not again.finished and again.state.step == 4
    assert open_result(out).modes.frequency == pytest.approx(first * np.sqrt(1.5), rel=1e-9)
    tables["static"]["end"] = 1.5
    run(arch_of(tmp_path, MPI.COMM_SELF, tables, modes={"count": 1}), out, restart=True)
    result = open_result(out)
    assert result.times[-1] == 1.5
    assert result.modes.frequency < first
    assert examine(result.path, deep=True) == []
    run(arch_of(tmp_path, MPI.COMM_SELF, tables), out, restart=True)


@pytest.mark.slow
def test_a_request_to_stop_before_the_modes(tmp_path):
    """The wall time is over after the only step: a checkpoint, from which a restart computes the modes."""
    tables = press(0.5) | {"static": {"step": 1.0}}
    case = arch_of(tmp_path, MPI.COMM_SELF, tables, modes={"count": 1})
    with pytest.raises(EarlyStop, match="the modes are not computed: continue with --restart"):
        Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True, wall_time=1e-9).run()
    assert open_result(tmp_path / "out").n_modes == 0
    run(case, tmp_path / "out", restart=True)
    assert open_result(tmp_path / "out").n_modes == 1


def test_signals_end_the_program_while_modes_are_computed(tmp_path, monkeypatch):
    """The libraries do not look at requests to stop; the handler of before the run is in force again."""

    class Screen(io.StringIO):
        def write(self, text):
            handlers[text] = signal.getsignal(signal.SIGTERM)
            return len(text)

    handlers, before = {}, signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("sys.stdout", Screen())
    Simulation(block(), MPI.COMM_SELF, output=tmp_path).run()
    told = {handler for text, handler in handlers.items() if "frequenc" in text}
    assert told == {before} < set(handlers.values())


def test_modes_of_the_initial_state_again(tmp_path, finished):
    shutil.copytree(finished, tmp_path / "out")
    assert run(block(), tmp_path / "out", restart=True).finished
    run(block(count=7), tmp_path / "out", restart=True)
    assert open_result(tmp_path / "out").n_modes == 7
    assert open_result(tmp_path / "out.1").n_modes == 8


def test_modes_at_the_end_of_time_stepping(tmp_path, finished):
    """A free block in flight: the frequencies are those of the block at rest, but for its strains."""
    data = block().to_dict()
    flight = {"time": {"integrator": "central_differences", "step": "auto", "end": 1e-3}, "output": {"fields_every": 0}}
    data |= flight | {"initial": {"velocity": [1.0, 0.0, 0.0]}}
    run(Case.from_dict(data), tmp_path / "flight")
    rest, found = (open_result(folder).modes.frequency for folder in (finished, tmp_path / "flight"))
    assert found[6:] == pytest.approx(rest[6:], rel=1e-8)


def test_where_slepc_is_not_there(monkeypatch):
    """SciPy takes its place up to a size, beyond which the case is refused before the run."""
    monkeypatch.setattr(choice, "has_slepc", lambda: False)
    monkeypatch.setattr(choice, "DENSE_UP_TO", 50)
    with Simulation(block(), MPI.COMM_SELF, check_only=True) as simulation:
        assert choice.describe_modes(simulation.model)["modes"].endswith("solver scipy")
    monkeypatch.setattr(choice, "GATHERED_AT_MOST", 60)
    with pytest.raises(InputError, match="free components need slepc4py"):
        Simulation(block(), MPI.COMM_SELF, check_only=True)
    with pytest.raises(InputError, match='modes.solver = "slepc": slepc4py is not installed'):
        Simulation(block(solver="slepc"), MPI.COMM_SELF, check_only=True)


def test_check_and_info_tell_of_modes(tmp_path, finished, capsys):
    (tmp_path / "block.toml").write_text(block().to_toml())
    assert main(["check", str(tmp_path / "block.toml")]) == 0
    assert "8 natural vibrations of the state at the end, lumped mass, solver dense" in capsys.readouterr().out
    assert main(["info", str(finished), "--verify"]) == 0
    told = capsys.readouterr().out
    frequency = open_result(finished).modes.frequency
    assert "modes of vibration:" in told and "frequency [Hz]" in told and f"{frequency[7]:.6g}" in told


@pytest.mark.parametrize("key", ["velocity", "angular_velocity"])
def test_initial_velocities_without_time_are_refused(key):
    data = block().to_dict() | {"initial": {key: [1.0, 0.0, 0.0]}}
    with pytest.raises(InputError, match=r"initial: a case with \[modes\] alone has no velocities"):
        Simulation(Case.from_dict(data), MPI.COMM_SELF, check_only=True)


def test_frames_of_modes(finished):
    with open_result(finished) as result:
        frames = mode_frames(result, [7, 8], period=4)
        assert len(frames.times) == 8
        rest = result.positions(-1)
        assert frames.positions(0) == pytest.approx(rest)
        moved = frames.positions(5) - rest
        shape = result.modes.shape[7]
        assert moved / np.abs(moved).max() == pytest.approx(shape / np.abs(shape).max(), abs=1e-12)
        assert np.linalg.norm(moved, axis=1).max() == pytest.approx(0.1 * np.linalg.norm([0.1, 0.1, 0.2]))
        assert frames.caption(5) == f"mode 8: {result.modes.frequency[7]:.6g} Hz"
        with pytest.raises(InputError, match="mode 9 does not exist"):
            mode_frames(result, [9])
        with pytest.raises(InputError, match="too few"):
            mode_frames(result, None, period=3)


def test_pictures_of_modes(tmp_path, finished):
    folder = shutil.copytree(finished, tmp_path / "out")
    written = render_modes(folder, modes=[7], period=4, size=(320, 180), video="none", note=lambda text: None)
    assert [path.relative_to(folder / "modes").as_posix() for path in written] == [
        "render.png",
        *(f"frames/frame_{k:04d}.png" for k in range(4)),
    ]
