"""Results with changed bits, bytes or pages: the damage is detected before it is used, and nothing crashes."""

import random
import shutil

import h5py
import numpy as np
import pytest
from helpers.kills import damaged, differences
from helpers.synthetic import Truss, options, write
from mpi4py import MPI

from pfem_petsc.errors import InputError
from pfem_petsc.output import integrity
from pfem_petsc.output.integrity import damages, examine
from pfem_petsc.output.result import open_result
from pfem_petsc.output.vtkhdf import ResultWriter

STEPS = 12


def written(path):
    truss = Truss(MPI.COMM_SELF)
    with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options()) as writer:
        write(writer, truss, range(STEPS), every=1)
    return truss


@pytest.mark.slow
def test_a_sound_file_is_sound(tmp_path):
    written(tmp_path / "result.vtkhdf")
    assert examine(tmp_path / "result.vtkhdf", deep=True) == []


DAMAGES = {
    "VTKHDF/Points": "Points of snapshot 3 (t = 0.03 s) does not match its checksum",
    "VTKHDF/PointData/displacement": "PointData/displacement of snapshot 3",
    "VTKHDF/CellData/stress": "CellData/stress of snapshot 3",
    "VTKHDF/Connectivity": "the connectivity of the bars",
    "VTKHDF/Offsets": "VTKHDF/Offsets does not match the mesh",
    "VTKHDF/Types": "other cells than lines",
    "VTKHDF/Steps/Values": "step and time of snapshot 3",
    "VTKHDF/Steps/PointOffsets": "VTKHDF/Steps/PointOffsets does not match",
    "snapshots/step": "step and time of snapshot 3",
    "history/momentum": "history: 1 rows do not match their checksums, the first is row 3",
    "history/wall/floor/force": "the first is row 3",
    "checks/history": "the first is row 3",
}


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGES)
def test_a_changed_value_is_named_and_not_continued(tmp_path, name):
    path = tmp_path / "result.vtkhdf"
    truss = written(path)
    with h5py.File(path, "r+") as file:
        rows = {"VTKHDF/Points": 3 * 23, "VTKHDF/PointData/displacement": 3 * 23, "VTKHDF/CellData/stress": 3 * 41}
        dataset = file[name]
        value = dataset[rows.get(name, 3)]
        dataset[rows.get(name, 3)] = value + np.ones_like(value)
    with h5py.File(path) as file:
        (line,) = damages(file)
    assert DAMAGES[name] in line
    if name == "history/momentum":
        with pytest.raises(InputError, match="damaged: .*not continued; restore it from a copy"):
            ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options(append_after_step=9))


@pytest.mark.slow
def test_what_follows_a_restart_has_its_checksums_too(tmp_path):
    path = tmp_path / "result.vtkhdf"
    truss = written(path)
    with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options(append_after_step=7)) as writer:
        write(writer, truss, range(8, 20), every=1)
    with h5py.File(path) as file:
        assert list(damages(file)) == []
    assert len(open_result(path).times) == 20


@pytest.mark.slow
def test_no_random_damage_is_continued_in_silence_or_ends_the_reader(tmp_path):
    whole = tmp_path / "whole.vtkhdf"
    truss = written(whole)
    expected = tmp_path / "expected.vtkhdf"
    shutil.copy(whole, expected)
    continued(expected, truss)
    chance = random.Random(3)
    for k in range(3):
        path = tmp_path / f"{k}.vtkhdf"
        shutil.copy(whole, path)
        what = damaged(path, chance)
        try:
            continued(path, truss)
        except InputError:
            continue
        assert differences(path, expected) == {}, what


def continued(path, truss):
    with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options(append_after_step=7)) as writer:
        write(writer, truss, range(8, STEPS), every=1)


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_checksum_of_long_arrays_is_that_of_their_pieces(kind):
    """Pieces of fewer words are summed without the compiled loop."""
    values = np.random.default_rng(3).normal(size=(5000, 3)).astype(kind)
    pieces = range(0, 5000, 1000)
    assert 3 * 1000 < integrity.COMPILED < values.size
    total = sum(integrity.word_sum(values[first : first + 1000], 77 + first) for first in pieces)
    assert integrity.word_sum(values, 77) == total % 2**64
