"""A mesh from arrays is read back as it is, and refused with what is wrong."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result, write_mesh
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab

POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
BARS = np.array([[0, 1], [1, 2]])


@pytest.mark.parallel
def test_arrays_become_a_case(comm, shared_tmp_path):
    """The same rod from the generator and from arrays: the same results to the last bit."""
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
    histories = []
    for number, mesh in enumerate(({"file": file}, {"generator": "rod", "length": 2.0, "elements": 2})):
        data = {
            "mesh": mesh,
            "node_set": {"tip": {"group": "tip"} if "file" in mesh else {"group": "end"}},
            "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "support": [{"node_set": "tip", "fix": "xyz"}],
            "initial": {"velocity": np.array([0.01, 0.0, 0.0])},
            "time": {"integrator": "central_differences", "step": 0.1, "end": np.float32(1.0)},
        }
        with Simulation(Case.from_dict(data), comm, output=shared_tmp_path / f"{number}", quiet=True) as simulation:
            assert simulation.run() == 0
        comm.Barrier()
        histories.append(open_result(shared_tmp_path / f"{number}").history["kinetic_energy"])
    np.testing.assert_array_equal(*histories)
    assert histories[0][0] > 0.0


@pytest.mark.parametrize(
    ("name", "points", "bars", "groups", "text"),
    [
        ("m.stl", POINTS, BARS, {}, r"m\.stl: no writer for \.stl; known suffixes: .*\.h5"),
        ("m.h5", POINTS[:, :2], BARS, {}, r"points has shape \(3, 2\) and type float64; expected \(points, 3\)"),
        ("m.h5", [[0, 0, 0], [1, 0]], BARS, {}, r"points has shape"),
        ("m.h5", POINTS + 1j, BARS, {}, r"points has .* complex128"),
        ("m.h5", POINTS, BARS.astype(float), {}, r"bars has shape \(2, 2\) and type float64; expected .* integers"),
        ("m.h5", POINTS, [], {}, r"bars has shape \(0,\)"),
        ("m.h5", POINTS, BARS + 1, {}, r"1 bars have an end that does not exist: bar 1 \(nodes 2 and 3\)"),
        ("m.h5", POINTS * np.nan, BARS, {}, r"coordinates that are not numbers"),
        ("m.h5", POINTS, BARS[:1], {}, r"1 nodes belong to no bar: node 2"),
        ("m.h5", POINTS, BARS, {"node_groups": {"a/b": [1]}}, r"node_groups\['a/b'\]: expected a name"),
        ("m.h5", POINTS, BARS, {"node_groups": {"a": [3]}}, r"node_groups\['a'\] has member 3, but .* 0 to 2"),
        ("m.h5", POINTS, BARS, {"node_groups": {"a": [-1]}}, r"has member -1"),
        ("m.h5", POINTS, BARS, {"bar_groups": {"a": [0.0]}}, r"bar_groups\['a'\] has shape \(1,\) and type float64"),
        ("m.h5", POINTS, BARS, {"bar_groups": {"a": np.ones(3, bool)}}, r"expected .* \(2,\) booleans"),
    ],
)
def test_arrays_that_are_no_mesh(tmp_path, name, points, bars, groups, text):
    with pytest.raises(InputError, match=text):
        write_mesh(tmp_path / name, points, bars, **groups)
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_file_that_cannot_be_written(tmp_path):
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
