"""A mesh from arrays is read back as it is, and refused with what is wrong."""

import numpy as np
import pytest

from pfem_petsc import Case, write_mesh
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab

POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
BARS = np.array([[0, 1], [1, 2]])


@pytest.mark.parallel
def test_lists_and_arrays_of_other_types_are_written(comm, shared_tmp_path):
    from mpi4py import MPI

    file = write_mesh(
        shared_tmp_path / "new folder" / "rod.h5",
        POINTS.tolist(),
        BARS.astype(np.uint8),
        node_groups={"tip": [2], "tail": np.arange(3) == 0, "nobody": []},
        bar_groups={"both": np.array([1, 0, 1])},
        comm=comm,
    )
    slab = read_slab(file, MPI.COMM_SELF)
    np.testing.assert_array_equal(slab.points, POINTS)
    np.testing.assert_array_equal(slab.bars, BARS)
    assert {name: list(m) for name, m in slab.node_groups.items()} == {"nobody": [], "tail": [0], "tip": [2]}
    assert {name: list(m) for name, m in slab.bar_groups.items()} == {"both": [0, 1]}


def test_a_mesh_file_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r"m\.stl: no writer for \.stl; known suffixes: .*\.h5"):
        write_mesh(tmp_path / "m.stl", POINTS, BARS)
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match=r"taken/m\.h5: cannot be written"):
        write_mesh(tmp_path / "taken" / "m.h5", POINTS, BARS)
    (tmp_path / "m.h5").mkdir()
    with pytest.raises(InputError, match=r"m\.h5: cannot be written"):
        write_mesh(tmp_path / "m.h5", POINTS, BARS)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["m.h5", "taken"]


def test_from_dict_tells_how_arrays_become_a_mesh():
    with pytest.raises(InputError, match=r"exactly one of the keys generator, file \(.*pfem_petsc\.write_mesh"):
        Case.from_dict({"mesh": {"points": POINTS, "bars": BARS}})
