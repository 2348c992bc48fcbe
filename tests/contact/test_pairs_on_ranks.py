"""Pairs are distributed with their nodes: no array of the size of all pairs, and the results of one rank."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.bodies import two_lattices
from helpers.lattices import planes, simulation
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.contact.constraint_set import ConstraintSet
from pfem_petsc.contact.transform import RowCoordinates
from pfem_petsc.stepping.model import Model


class Counting(MPI.Intracomm):
    """A communicator that keeps how many bytes its reductions had; what ranks gather as objects must be small, but for
    the nodes of a face while they are matched."""

    sizes: list[int]

    def Allreduce(self, sendbuf, recvbuf, op=MPI.SUM):  # noqa: N802
        self.sizes.append(recvbuf.nbytes)
        super().Allreduce(sendbuf, recvbuf, op)

    def allgather(self, sendobj):
        assert isinstance(sendobj, np.ndarray) or len(repr(sendobj)) < 200
        return super().allgather(sendobj)


def arrays_of(thing, seen):
    """All arrays that an object and its parts refer to, but for those of mesh and walls."""
    if id(thing) in seen or type(thing).__name__ in ("DistributedMesh", "Contact", "Counting"):
        return
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        yield thing
    elif isinstance(thing, (list, tuple, set)):
        for part in thing:
            yield from arrays_of(part, seen)
    elif isinstance(thing, dict):
        yield from arrays_of(list(thing.values()), seen)
    elif type(thing).__module__.startswith("pfem_petsc"):
        yield from arrays_of(vars(thing), seen)


@pytest.mark.parallel
def test_nothing_is_of_the_size_of_all_pairs(comm, shared_tmp_path):
    """Faces of 5 x 21 and 5 x 41 nodes: what a rank has, sends and reduces."""
    reduced = []
    for k, cells in enumerate([(1, 1, 10), (1, 1, 20)]):
        case = Case.from_dict(two_lattices(shared_tmp_path / f"{k}.vtu", "newmark", cells=cells))
        model = Model(case, comm)
        counting = Counting(model.mesh.comm)
        counting.sizes = []
        model.mesh.comm = counting
        pairs = ConstraintSet(case, model.nodes, model.contact)
        two = pairs.two
        total = comm.allreduce(int(two.counted.sum()))
        assert total == len(case.node_set["left"].indices)
        # each pair is where its nodes are, and nowhere else
        assert (two.nodes >= 0).any(axis=0).all()
        ends = comm.allreduce(int((two.nodes >= 0).sum()))
        assert ends == 2 * total
        x = model.mesh.points[: model.mesh.n_owned].copy()
        u, mass = 0.01 * np.ones_like(x), np.ones(len(x))
        u[:, 0] *= np.where(x[:, 0] > 0.1, -1.0, 1.0)
        coordinates = RowCoordinates(pairs)
        pairs.force = two.separate(x, u, mass, np.zeros_like(x))
        assert pairs.any_pressed()
        two.together(u, mass, pairs.force > 0.0)
        coordinates.feasible(x, u, mass)
        for change in (coordinates.forward, coordinates.adjoint, coordinates.inverse):
            change(u)
        assert coordinates.broken(x - u, 0.0) in (True, False)
        axes = {length for array in arrays_of([pairs, coordinates], set()) for length in array.shape}
        own = len(two.at)
        assert max(axes) <= max(36 * own + 1, 16)  # the transform couples six unknowns
        if comm.size == 3:  # ranks have a part of the pairs each, so that arrays of all would be seen
            explained = {k * own + extra for k in range(1, 37) for extra in (0, 1)} | {len(u), model.mesh.n_local}
            assert own + 1 < total and not (axes - explained) & {total, 2 * total, 6 * total}
        reduced.append(sorted(counting.sizes))
    assert reduced[0] == reduced[1]


@pytest.mark.parallel
def test_a_step_sends_what_the_distance_depends_on(comm, shared_tmp_path):
    """One number per node and direction along an axis, and compliances only where the stiffness is another array."""
    case = two_lattices(shared_tmp_path / "m.vtu", "central_differences", direction=(2.0, 0.0, 0.0))
    model = Model(Case.from_dict(case), comm)
    pairs, widths = model.links, []
    partners = pairs.rows.partners
    bring = partners.bring

    def counting(leaving):
        widths.append(leaving.shape[1])
        return bring(leaving)

    partners.bring = counting
    x = model.mesh.points[: model.mesh.n_owned].copy()
    approach = 0.01 * np.where(x[:, :1] > 0.1015, -1.0, 1.0) * [1.0, 0.3, 0.2]
    forces, sent = [], [2, 1, 2]  # messages of steps with a stiffness, with the same one, and with another one
    for hard, messages in zip((soft := np.full(len(x), 2.0), soft, np.full(len(x), 4.0)), sent, strict=True):
        u = approach.copy()
        widths.clear()
        contact = pairs.explicit(SimpleNamespace(predictor=x), None, u, hard, np.zeros_like(x), 1e-12)
        assert widths == ([] if partners.alone else [1] * messages)
        forces.append(pairs.force.copy())
        gap = pairs.rows.values(pairs.rows.gather(x + u))
        assert gap[pairs.force > 0.0] == pytest.approx(0.0, abs=1e-15)
        assert np.allclose(u, approach + contact / hard[:, None], rtol=0, atol=1e-15)
        assert (contact[:, 1:] == 0.0).all()
    assert pairs.any_pressed()
    assert np.array_equal(forces[0], forces[1])
    assert np.allclose(2.0 * forces[0], forces[2], rtol=1e-14, atol=0.0)


CASES = {
    "explicit": ("central_differences", False, {}),
    "explicit, supported": ("chung_lee", False, {"supports": [{"node_set": "held", "fix": "y"}]}),
    "explicit, stick": ("chung_lee", False, {"contact": {"treatment": "stick"}}),
    "in several pairs": ("central_differences", True, {}),
    "in several pairs and on walls": (
        "central_differences",
        True,
        {"wall": planes([[0.0, 0.1, 1.0], [0.1, 1.0, -0.2]], [-0.001, -0.04])},
    ),
    "implicit": ("newmark", False, {"solver": {"rtol": 1e-13}}),
    "implicit, conserving": ("newmark", False, {"solver": {"rtol": 1e-13}, "contact": {"treatment": "conserving"}}),
    "implicit, stick": ("newmark", False, {"solver": {"rtol": 1e-13}, "contact": {"treatment": "stick"}}),
    "implicit, on walls": (
        "newmark",
        False,
        {"solver": {"rtol": 1e-13}, "wall": planes([[0.0, 0.1, 1.0]], [-0.001])},
    ),
}


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_ranks_give_what_one_gives(name, comm, shared_tmp_path):
    integrator, crowded, tables = CASES[name]
    tables = {key: value for key, value in tables.items() if key != "wall"}
    case = two_lattices(shared_tmp_path / "m.vtu", integrator, step=5e-4, end=0.008, **tables)
    case["wall"] = CASES[name][2].get("wall", [])
    if crowded:
        case["contact_pair"].append({**case["contact_pair"][0], "name": "across", "direction": [1.0, -0.4, 0.3]})
    run = simulation(case, comm, shared_tmp_path, "ranks")
    cut = comm.allreduce(int((run.model.links.two.nodes < 0).sum()))
    assert comm.size < 3 or cut > 0
    rows = [step.row for step in run]
    alone = simulation(case, MPI.COMM_SELF, shared_tmp_path, f"alone{comm.rank}")
    others = [step.row for step in alone]
    assert max(abs(row["pair/faces/force"]).max() for row in rows) > 0.1
    for row, other in zip(rows, others, strict=True):
        for key in ("pair/faces/force", "pair/faces/impulse", "pair/faces/jump_impulse", "momentum"):
            np.testing.assert_allclose(row[key], other[key], atol=1e-9 * max(1.0, np.abs(other[key]).max()))
        assert row["active_contacts"] == other["active_contacts"]
        assert row["impact_dissipation"] == pytest.approx(other["impact_dissipation"], abs=1e-12)
    x, y = run.gather(run.state.position), alone.gather(alone.state.position)
    if comm.rank == 0:
        np.testing.assert_allclose(x, y, atol=1e-11)


@pytest.mark.parametrize("floor", [False, True], ids=["pairs", "pairs on a floor"])
def test_steps_call_no_function_for_each_pair(floor, comm, shared_tmp_path):
    """What Python calls in a step does not depend on how many pairs there are, in contact."""
    calls = []
    for k, cells in enumerate([(1, 1, 4), (1, 1, 12)]):
        case = two_lattices(shared_tmp_path / f"{k}.vtu", "central_differences", cells=cells, end=0.01)
        case["initial"] |= {"angular_velocity": [0.0, 0.0, 0.0]}
        case["initial"]["on"][0] |= {"angular_velocity": [0.0, 0.0, 0.0]}
        case["contact_pair"][0]["direction"] = [1.0, 0.0, 0.0]
        case["wall"] = planes([[0.0, 0.0, 1.0]], [-0.0011]) if floor else []
        run = simulation(case, comm, shared_tmp_path, f"r{k}")
        counts = []

        def count(frame, event, argument, counts=counts):
            if event in ("call", "c_call"):
                counts[-1][0] += 1

        for _ in run:
            counts.append([0, 0])
            sys.setprofile(count)
            run.stepper.solve(run.stepper.balance)
            sys.setprofile(None)
            counts[-1][1] = int((run.model.links.force > 0.0).sum())
        assert max(pressed for _, pressed in counts) > 5
        calls.append(max(number for number, _ in counts))
    assert calls[1] <= calls[0] + 20
