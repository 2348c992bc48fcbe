"""Tables over time against NumPy and the conditions of a spline; many loads, and loads from files."""

import numpy as np
import pytest
from helpers.meshes import every_node
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.errors import InputError
from pfem_petsc.mechanics.motion import Group, TimeTables, grouped
from pfem_petsc.restart import changed_keys
from pfem_petsc.stepping.model import Model

AT = [-1.0, 0.0, 0.1, 0.5, 1.0, 1.3, 2.0, 2.9999, 3.0, 7.0]


def test_linear_tables_have_the_bits_of_numpy():
    rng = np.random.default_rng(1)
    times = [np.cumsum(rng.uniform(0.1, 1.0, n)) - 1.0 for n in (1, 2, 5, 5, 40)]
    tables = [(np.column_stack([t, rng.normal(size=len(t))]), False) for t in [*times, times[2]]]
    groups, columns = grouped(tables)
    assert [group.values.shape[1] for group in groups] == [1, 1, 2, 1, 1]
    together, out = TimeTables(groups), np.empty(len(tables))
    for time in [*AT, *times[4][[0, 7, 39]]]:
        together.at(time, out)
        np.testing.assert_array_equal(out[columns], [np.interp(time, rows[:, 0], rows[:, 1]) for rows, _ in tables])


def test_smooth_tables_are_splines():
    """Through the rows, with continuous first and second derivatives, level at both ends and beyond."""
    times, values = np.array([0.0, 0.4, 1.0, 1.7, 3.0]), np.array([0.0, 1.0, -1.0, 0.5, 2.0])
    tables = TimeTables([Group(times, np.column_stack([values, -3.0 * values]), True)])

    def at(time):
        out = np.empty(2)
        tables.at(time, out)
        assert out[1] == pytest.approx(-3.0 * out[0], abs=1e-14)
        return out[0]

    assert [at(t) for t in times] == pytest.approx(values, abs=1e-15)
    assert at(-1.0) == 0.0 and at(5.0) == 2.0
    h = 1e-4
    for t in times[1:-1]:
        left = np.polyfit(-h * np.arange(4), [at(t - k * h) for k in range(4)], 3)
        right = np.polyfit(h * np.arange(4), [at(t + k * h) for k in range(4)], 3)
        assert left[2] == pytest.approx(right[2], abs=1e-8)
        assert left[1] == pytest.approx(right[1], abs=1e-3 * abs(left[1]))
    for t, inward in ((times[0], h), (times[-1], -h)):
        assert (at(t + inward) - at(t)) / inward == pytest.approx(0.0, abs=50.0 * h)


def case(load, **tables):
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 4.0, "elements": 4},
            "node_set": {"end": {"group": "end"}, "two": {"indices": [1, 2]}},
            "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "load": load,
            "time": {"integrator": "central_differences", "step": 0.1, "end": 1.0},
            **tables,
        }
    )


def forces(the_case, time, comm=MPI.COMM_SELF):
    model = Model(the_case, comm)
    return every_node(model, model.external.at(time, np.empty((model.mesh.n_owned, 3))))


TIMES = np.array([0.0, 0.5, 2.0])
HISTORY = np.random.default_rng(3).normal(size=(3, 2, 3))
FACTOR = np.array([[0.0, 1.0], [2.0, 1.0], [2.0, -1.0]])
FORCE = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, -5.0]])


def interpolated(time, rows):
    flat = rows.reshape(len(rows), -1)
    return np.array([np.interp(time, TIMES, column) for column in flat.T]).reshape(rows.shape[1:])


@pytest.mark.parallel
@pytest.mark.parametrize("time", [-0.5, 0.0, 0.3, 1.9, 2.0, 4.0])
def test_forces_of_a_file(comm, shared_tmp_path, time):
    """Histories of nodes, factors, constant forces, node sets by name; from arrays and from text."""
    t, folder = TIMES, shared_tmp_path
    if comm.rank == 0:
        np.savez(folder / "histories.npz", time=t, nodes=np.array([3, 0]), force=HISTORY)
        np.savez(folder / "factors.npz", time=1e3 * t, nodes=np.array([3, 0]), force=FORCE, factor=FACTOR)
        np.savez(folder / "constant.npz", nodes=np.array([3, 0]), force=FORCE)
        np.savez(folder / "sets.npz", time=t, two=HISTORY[:, 0], end=HISTORY[:, 1], **{"0": HISTORY[:, 0]})
        rows = np.column_stack([t, HISTORY[:, 0, 2], HISTORY[:, 1, 0]]).tolist()
        lines = ["time, two.z, 4.x", *(", ".join(map(repr, row)) for row in rows)]
        (folder / "sets.csv").write_text("\n".join(lines))
    comm.barrier()

    def of(**load):
        return forces(case([{**load, "file": str(folder / load["file"])}]), time, comm)

    expected = np.zeros((5, 3))
    expected[[3, 0]] = interpolated(time, HISTORY)
    np.testing.assert_allclose(of(file="histories.npz"), expected, rtol=1e-15)
    np.testing.assert_allclose(of(file="histories.npz", scale=-2.0), -2.0 * expected, rtol=1e-15)
    expected[[3, 0]] = interpolated(time, FACTOR)[:, None] * FORCE
    np.testing.assert_allclose(of(file="factors.npz", time_scale=1e-3), expected, rtol=1e-13, atol=1e-15)
    expected[[3, 0]] = FORCE
    np.testing.assert_array_equal(of(file="constant.npz"), expected)
    first, second = interpolated(time, HISTORY)
    np.testing.assert_allclose(of(file="sets.npz"), [first, first, first, np.zeros(3), second], rtol=1e-15)
    of_text = np.zeros((5, 3))
    of_text[[1, 2], 2], of_text[4, 0] = first[2], second[0]
    np.testing.assert_allclose(of(file="sets.csv"), of_text, rtol=1e-15)


def test_loads_of_all_kinds_add_up(tmp_path):
    """In the order of the case, constant ones with a load factor in a static analysis."""
    np.savez(tmp_path / "x.npz", nodes=np.array([4]), force=np.array([[0.0, 1.0, 0.0]]))
    load = [
        {"node_set": "end", "force": [1.0, 0.0, 0.0]},
        {"file": str(tmp_path / "x.npz")},
        {"node_set": "end", "force": [0.0, 0.0, 2.0], "table": [[0.0, 0.0], [2.0, 1.0]]},
        {"node_set": "end", "force": [0.0, 0.0, 7.0], "table": [[0.0, 0.0], [2.0, 1.0]], "interpolation": "smooth"},
    ]
    ramp = 0.25**2 * (3.0 - 2.0 * 0.25)  # two rows: the cubic that is level at both
    assert forces(case(load), 0.5)[4].tolist() == pytest.approx([1.0, 1.0, 0.5 + 7.0 * ramp], rel=1e-15)
    static = case(load).to_dict()
    del static["time"]
    static["static"] = {"method": "newton"}
    assert forces(Case.from_dict(static), 0.5)[4].tolist() == pytest.approx([0.5, 0.5, 0.5 + 7.0 * ramp], rel=1e-15)


REFUSED = {
    "nothing": ({}, "expected the arrays time, nodes, force"),
    "no nodes": ({"force": FORCE}, "there is no array 'nodes'; the file has force"),
    "no time": ({"nodes": [1, 2], "force": HISTORY}, "there is no array 'time'"),
    "other shape": ({"time": TIMES[:2], "nodes": [1, 2], "force": HISTORY}, r"'force' has the shape \(3, 2, 3\)"),
    "factors": ({"time": TIMES, "nodes": [1, 2], "force": FORCE, "factor": FACTOR[:, :1]}, "'factor' has the shape"),
    "twice": ({"nodes": [1, 1], "force": FORCE}, "a node number is listed twice"),
    "not numbers": ({"nodes": ["a", "b"], "force": FORCE}, "array 'nodes' has the type"),
    "not finite": ({"nodes": [1, 2], "force": FORCE * np.nan}, r"entry \[0, 0\] is not finite"),
    "history not finite": (
        {"time": TIMES, "nodes": [1, 2], "force": HISTORY * np.inf},
        r"entry \[[0-9], 0, [0-9]\] is not finite",
    ),
    "times": ({"time": TIMES[[0, 0, 1]], "nodes": [1, 2], "force": HISTORY}, "row 1: times must increase"),
    "node": ({"nodes": [1, 5], "force": FORCE}, "there is no node 5: the mesh has the nodes 0 to 4"),
    "unknown array": ({"nodes": [1, 2], "force": FORCE, "sets": [1]}, "unknown array 'sets'"),
    "unknown set": ({"time": TIMES, "ends": HISTORY[:, 0]}, "there is no node set 'ends', did you mean 'end'"),
}


@pytest.mark.parametrize("arrays, told", REFUSED.values(), ids=REFUSED)
def test_refused_files_of_forces(tmp_path, arrays, told):
    with np.errstate(all="ignore"):
        np.savez(tmp_path / "x.npz", **{name: np.array(array) for name, array in arrays.items()})
    the_case = case([{"file": str(tmp_path / "x.npz")}])
    with pytest.raises(InputError, match=r"load\[0\].file = .*: .*" + told):
        Model(the_case, MPI.COMM_SELF)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("t,a\n0,1\n", "column 1 has the heading 'a': expected NAME.x"),
        ("t,end.x,end.x\n0,1,2\n", "two columns have the same heading"),
        ("t,end.x\n0,1\n1,nan\n", "line 3: expected finite numbers"),
        ("t,end.x\n0,1\n0,2\n", "line 3: times must increase"),
        ("t\n0\n", "expected the time and columns"),
    ],
)
def test_refused_texts_of_forces(tmp_path, text, told):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(InputError, match=r"load\[0\].file = .*: .*" + told):
        Model(case([{"file": str(tmp_path / "x.csv")}]), MPI.COMM_SELF)


def test_refused_keys_of_files(tmp_path):
    with pytest.raises(InputError, match=r"load\[0\].file = .*: there is no file none.npz in"):
        case([{"file": str(tmp_path / "none.npz")}])
    with pytest.raises(InputError, match=r"load\[0\]: file gives the forces .* without node_set, force"):
        case([{"file": "x.npz", "node_set": "end", "force": [0.0, 0.0, 1.0]}])
    with pytest.raises(InputError, match=r"load\[0\].force: this key is missing"):
        case([{"node_set": "end"}])


def test_a_changed_file_is_noticed(tmp_path):
    """The resolved case knows the content by its digest, and does not read the file."""
    np.savez(tmp_path / "x.npz", nodes=np.array([4]), force=FORCE[:1])
    first = case([{"file": str(tmp_path / "x.npz")}])
    again = Case.from_toml(first.to_toml())
    assert again == first and len(again.load[0].digest) == 64
    np.savez(tmp_path / "x.npz", nodes=np.array([4]), force=FORCE[1:])
    assert Case.from_toml(first.to_toml()) == first
    now = case([{"file": str(tmp_path / "x.npz")}])
    with pytest.raises(InputError, match=r"belongs to a different case .*: load\[0\].digest: "):
        changed_keys(tmp_path / "checkpoint.h5", first.to_dict(), now.to_dict(), "case")
    with pytest.raises(InputError, match="this file is not the one that the case was made with"):
        Model(again, MPI.COMM_SELF)
