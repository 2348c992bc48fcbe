"""Checkpoints: bitwise on any number of ranks, never incomplete, and damage is refused with the reason."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.launch import environment
from mpi4py import MPI

from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.output.checkpoint import Checkpoint, newest_checkpoint, write_checkpoint
from pfem_petsc.output.hdf5 import require_room
from pfem_petsc.parallel.natural import NaturalOrder

COMM = MPI.COMM_WORLD
N = 53
SCALARS = {"time": 0.1 + 0.2, "step": 7, "tiny": 5e-324, "lists": [1.5, [2.0]], "infinite": float("inf"), "text": "é"}
ATTRIBUTES = {"case": 'title = "x"\n', "ranks": 1}


def values(n=N):
    random = np.random.default_rng(3)
    x = random.standard_normal((n, 3)) * 10.0 ** random.integers(-300, 300, size=(n, 3))
    x[0] = [-0.0, np.nan, np.inf]
    return {"positions": x, "active": random.integers(0, 99, n).astype(np.int32), "on": random.random(n) < 0.5}


def owned_ids(comm, seed, n=N):
    random = np.random.default_rng(seed)
    ids, owner = random.permutation(n), random.integers(max(1, comm.size - 1), size=n)
    return ids[owner == comm.rank]  # the last of several ranks owns nothing


def write(path, comm=COMM, seed=1, scalars=SCALARS):
    order = NaturalOrder(comm, owned_ids(comm, seed), N)
    arrays = {name: (order, array[owned_ids(comm, seed)]) for name, array in values().items()}
    write_checkpoint(path, comm, arrays, scalars, ATTRIBUTES)


def read(path, comm=COMM, seed=2, names=("positions", "active", "on"), n=N):
    order = NaturalOrder(comm, owned_ids(comm, seed, n), n)
    with Checkpoint(path, comm) as file:
        return file.read(dict.fromkeys(names, order)), file


@pytest.mark.parallel
def test_everything_comes_back_bit_for_bit_with_other_owners(shared_tmp_path):
    write(shared_tmp_path / "checkpoint.h5")
    arrays, found = read(shared_tmp_path / "checkpoint.h5")
    for name, array in values().items():
        mine = array[owned_ids(COMM, 2)]
        assert arrays[name].dtype == mine.dtype
        assert arrays[name].tobytes() == mine.tobytes()
    assert found.scalars == SCALARS
    assert found.attributes == ATTRIBUTES


@pytest.mark.parallel
def test_a_file_of_all_ranks_equals_that_of_one(shared_tmp_path):
    write(shared_tmp_path / "checkpoint.h5")
    if COMM.rank == 0:
        write(shared_tmp_path / "alone.h5", MPI.COMM_SELF, seed=5)
        with h5py.File(shared_tmp_path / "checkpoint.h5") as a, h5py.File(shared_tmp_path / "alone.h5") as b:
            assert sorted(a["arrays"]) == sorted(b["arrays"])
            for name in a["arrays"]:
                assert a["arrays"][name][()].tobytes() == b["arrays"][name][()].tobytes()
        assert read(shared_tmp_path / "alone.h5", MPI.COMM_SELF)[1].scalars == SCALARS


@pytest.mark.parallel
def test_the_one_before_is_kept_and_no_other_file(shared_tmp_path):
    for step in (1, 2, 3):
        write(shared_tmp_path / "checkpoint.h5", scalars={"step": step})
    assert sorted(os.listdir(shared_tmp_path)) == ["checkpoint-previous.h5", "checkpoint.h5"]
    assert read(shared_tmp_path / "checkpoint.h5")[1].scalars["step"] == 3
    assert read(shared_tmp_path / "checkpoint-previous.h5")[1].scalars["step"] == 2
    assert newest_checkpoint(shared_tmp_path) == shared_tmp_path / "checkpoint.h5"
    COMM.Barrier()
    if COMM.rank == 0:
        (shared_tmp_path / "checkpoint.h5").unlink()
    COMM.Barrier()
    assert newest_checkpoint(shared_tmp_path) == shared_tmp_path / "checkpoint-previous.h5"


@pytest.mark.parallel
def test_missing_other_mesh_other_array_other_version(shared_tmp_path):
    path = shared_tmp_path / "checkpoint.h5"
    with pytest.raises(InputError, match=r"checkpoint\.h5: there is no such checkpoint"):
        read(path)
    write(path)
    with pytest.raises(InputError, match="positions has 53 rows, the case needs 54"):
        read(path, n=54)
    with pytest.raises(InputError, match="no array 'velocities' .it has active, on, positions"):
        read(path, names=["velocities"])
    COMM.Barrier()
    if COMM.rank == 0:
        path.write_bytes(path.read_bytes().replace(b"pfem_petsc checkpoint 2\n", b"pfem_petsc checkpoint 3\n"))
    COMM.Barrier()
    with pytest.raises(InputError, match="version 3 of the checkpoint format, this program reads 2"):
        read(path)


@pytest.mark.parallel
def test_no_folder_is_a_failure_on_all_ranks(shared_tmp_path):
    with pytest.raises(SimulationFailure, match="gone"):
        write(shared_tmp_path / "removed" / "checkpoint.h5")


def test_any_flipped_bit_or_cut_is_refused_or_harmless(tmp_path):
    path = tmp_path / "checkpoint.h5"
    write(path, MPI.COMM_SELF)
    write(path, MPI.COMM_SELF)
    whole = path.read_bytes()
    expected = {name: array[owned_ids(MPI.COMM_SELF, 2)].tobytes() for name, array in values().items()}
    random = np.random.default_rng(0)
    refused = 0
    for position in random.integers(len(whole), size=150):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        try:
            arrays, found = read(path, MPI.COMM_SELF)
        except InputError as error:
            assert "checkpoint.h5" in str(error)
            refused += 1
        else:  # the flip hit a byte that means nothing
            assert {name: array.tobytes() for name, array in arrays.items()} == expected
            assert found.scalars == SCALARS
    assert refused > 50
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 8):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"(damaged|not a).*restart from the one before: --restart .*previous"):
            read(path, MPI.COMM_SELF)


def test_damaged_values_are_named(tmp_path):
    path = tmp_path / "checkpoint.h5"
    write(path, MPI.COMM_SELF)
    with h5py.File(path, "r") as file:
        offset = file["arrays/active"].id.get_offset()
        assert path.read_bytes()[offset:].startswith(values()["active"].tobytes())
    with path.open("r+b") as raw:
        raw.seek(offset + 12)
        raw.write(b"\xff")
    with pytest.raises(InputError, match="values of active do not match their checksum; start without --restart"):
        read(path, MPI.COMM_SELF)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "checkpoint.h5"
    with h5py.File(path, "w") as file:
        file["arrays/positions"] = np.zeros((N, 3))
    for content in (path.read_bytes(), b"", b"text\n", b"pfem_petsc checkpoint 2\n", b"pfem_petsc checkpoint 2\n{}\n"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"checkpoint\.h5: (not a checkpoint|damaged)"):
            read(path, MPI.COMM_SELF)


def test_many_arrays(tmp_path):
    order = NaturalOrder(MPI.COMM_SELF, np.arange(5), 5)
    arrays = {f"array{i}": (order, np.full(5, i, dtype=np.int64)) for i in range(200)}
    write_checkpoint(tmp_path / "c.h5", MPI.COMM_SELF, arrays, {}, {})
    with Checkpoint(tmp_path / "c.h5", MPI.COMM_SELF) as file:
        found = file.read(dict.fromkeys(arrays, order))
    assert all((found[f"array{i}"] == i).all() for i in range(200))


HERE = f"{Path(__file__).parent}:{Path(__file__).parents[1]}"

WRITER = """
import sys
from pathlib import Path
from mpi4py import MPI
sys.path[:0] = sys.argv[1].split(':')
from test_checkpoint import write
step = 0
while True:
    step += 1
    write(Path(sys.argv[2]) / "checkpoint.h5", scalars={"step": step})
    print(step, flush=True)
"""


@pytest.mark.slow
def test_a_kill_leaves_a_complete_checkpoint(tmp_path, chance):
    for _ in range(3):
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, HERE, str(tmp_path)],
            stdout=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        try:
            written = int(writer.stdout.readline())
            for _more in range(int(chance.integers(1, 5))):
                written = int(writer.stdout.readline())
        finally:
            writer.kill()
            written += len(writer.stdout.read().split())
            writer.wait()
        arrays, found = read(newest_checkpoint(tmp_path), MPI.COMM_SELF)
        assert found.scalars["step"] >= written - 1 > 0
        assert arrays["positions"].tobytes() == values()["positions"][owned_ids(MPI.COMM_SELF, 2)].tobytes()


def test_limit_of_file_sizes_is_no_damage(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    (tmp_path / "file").write_bytes(bytes(2_000_000))
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, limits[1]))
    try:
        require_room(MPI.COMM_SELF, tmp_path / "file", 500_000)
        with pytest.raises(SimulationFailure, match=r"ulimit -f: 4\.0 MB for a file\): 2\.0 MB are free"):
            require_room(MPI.COMM_SELF, tmp_path / "file", 1_000_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_disk_full_keeps_the_checkpoint_before(small_disk):
    path = small_disk / "checkpoint.h5"
    write(path, MPI.COMM_SELF)
    before = path.read_bytes()
    n = 300_000
    order = NaturalOrder(MPI.COMM_SELF, np.arange(n), n)
    with pytest.raises(SimulationFailure, match="disk full"):
        write_checkpoint(path, MPI.COMM_SELF, {"x": (order, np.zeros((n, 3)))}, {}, {})
    assert os.listdir(small_disk) == ["checkpoint.h5"]
    assert path.read_bytes() == before
