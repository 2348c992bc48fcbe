"""Rows over several nodes live where their nodes do: nothing of the size of all rows, and the results of one rank."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.contact.constraint_set import _part
from pfem_petsc.contact.constraints.base import Constraint
from pfem_petsc.contact.constraints.base import ConstraintKeys as Parameters
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.mesh.slab import slab_range
from pfem_petsc.stepping.model import Model

WALL = 'wall=[{name="floor", type="plane", point=[0, 0, -0.02], normal=[0, 0, 1]}]'


def places(n: int) -> np.ndarray:
    """(n, 3) [m] of all nodes, of which the mesh knows nothing."""
    return 1e-2 * np.random.default_rng(1).normal(size=(n, 3))


class Ropes(Constraint):
    """Ropes of their own lengths between nodes that are drawn at random, or, of "angles", rows over three nodes."""

    part = (0, 1)  # this rank and how many there are, of the model being made
    distant = True

    def __init__(self, parameters, nodes_of) -> None:
        n, wide = int(parameters.name.split()[-1]), 3 if parameters.name.startswith("angles") else 2
        rng = np.random.default_rng(wide)
        nodes = np.array([rng.choice(n, wide, replace=False) for _ in range(n // 4)])
        if not self.distant:
            nodes = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
        arms = np.diff(places(n)[nodes], axis=1)
        lengths = np.sqrt((arms**2).sum(axis=2)).sum(axis=1)[:, None] * rng.uniform(1.0, 1.05, (len(nodes), 1))
        here = slice(*slab_range(len(nodes), *self.part))
        self.nodes, self.data = nodes[here], lengths[here]

    def values(self, x):
        return self.data[:, 0] - np.sqrt(((x[:, 1:] - x[:, :-1]) ** 2).sum(axis=2)).sum(axis=1)

    def gradients(self, x):
        arms = x[:, 1:] - x[:, :-1]
        along = arms / np.maximum(np.sqrt((arms**2).sum(axis=2)), 1e-300)[:, :, None]
        nothing = np.zeros_like(along[:, :1])
        return np.concatenate([along, nothing], axis=1) - np.concatenate([nothing, along], axis=1)


@pytest.fixture
def ropes(monkeypatch):
    module = type("module", (), {"Parameters": Parameters, "Constraint": Ropes})
    for place in ("case.model", "contact.constraint_set"):
        found = importlib.import_module(f"pfem_petsc.{place}")
        own = found.lookup
        monkeypatch.setattr(
            found, "lookup", lambda package, name, where, own=own: module if name == "d" else own(package, name, where)
        )


def make(comm, *keys, names=("ropes", "angles"), cells=(3, 2, 2)):
    """A lattice of 1 mm with ropes over it."""
    Ropes.part = comm.rank, comm.size
    own = [f"mesh.cells={list(cells)}", "mesh.pitch=0.001", "wall=[]", "contact={}", "time.step=1e-6", *keys]
    own += ["node_set.corner.nearest=[0, 0, 0]", 'support=[{node_set="corner", fix="xz"}]']
    n = Model(Case.load("tumbling_lattice", own), MPI.COMM_SELF).mesh.n_nodes
    tables = ", ".join(f'{{name="{name} {n}", kind="d"}}' for name in names)
    return Model(Case.load("tumbling_lattice", [*own, f"constraint=[{tables}]"]), comm)


def press(model, at_start):
    """Positions of a step that scatters the nodes, as the ropes let it: u, contact forces, and whether any presses."""
    link = model.links
    ids, n = model.mesh.node_ids[: model.mesh.n_owned], model.mesh.n_nodes
    rng = np.random.default_rng(3)
    way, mass = rng.normal(size=(n, 3)), rng.uniform(1.0, 3.0, n)
    predictor, u, stiffness = places(n)[ids], 5e-4 * way[ids], mass[ids]
    u[model.supports.fixed] = 0.0
    state = SimpleNamespace(position=predictor.copy(), time=0.0, contact=np.zeros_like(u))
    model.contact.state = state
    balance = SimpleNamespace(predictor=predictor, time=1e-6, acting=0.0 if at_start else 1.0)
    none = np.zeros_like(u)
    contact = link.explicit(balance, state, u, stiffness, none, 1e-15)
    return link, predictor + u, contact, contact is not none


@pytest.mark.parallel
@pytest.mark.parametrize("walls", [(), (WALL,)])
@pytest.mark.parametrize("at_start", [False, True])
def test_forces_are_those_of_one_rank(at_start, walls, ropes, comm):
    """To the last bit, at nodes and in rows; ropes are kept, and forces are between nodes."""
    model, alone = make(comm, *walls), make(MPI.COMM_SELF, *walls)
    link, x, contact, _ = press(model, at_start)
    whole, x_whole, contact_whole, pressed = press(alone, at_start)
    assert pressed and (whole.force > 0.0).sum() > 3
    order = np.argsort(alone.mesh.node_ids)[model.mesh.node_ids[: model.mesh.n_owned]]
    assert x.tobytes() == x_whole[order].tobytes()
    assert contact.tobytes() == contact_whole[order].tobytes()
    every = {(s, k): f for s, k, f in zip(whole.rows.source, whole.rows.ids, whole.force, strict=True)}
    mine = {(s, k): f for s, k, f in zip(link.rows.source, link.rows.ids, link.force, strict=True)}
    assert mine == {key: every[key] for key in mine}
    assert comm.allreduce(int(link.rows.counted.sum())) == len(every)
    kept = link.rows.values(link.rows.gather(x))
    if not walls:  # which follow
        assert kept.min(initial=0.0) > -1e-14
        assert np.abs(kept[link.force > 0.0]).max(initial=0.0) < 1e-14
        assert np.abs(comm.allreduce(contact.sum(axis=0))).max() < 1e-12
    totals = comm.allreduce(link.totals())
    np.testing.assert_allclose(totals, whole.totals(), rtol=0, atol=1e-13 * np.abs(whole.totals()).max())
    held = np.zeros(model.mesh.n_owned, dtype=bool)
    link.mark(held)
    expected = np.zeros(alone.mesh.n_owned, dtype=bool)
    whole.mark(expected)
    assert (held == expected[order]).all()


@pytest.mark.parallel
def test_checkpoints_hold_rows_in_their_own_order(ropes, comm):
    """What one rank writes several read, and the other way round."""
    model, alone = make(comm), make(MPI.COMM_SELF)
    link, *_ = press(model, True)
    whole, *_ = press(alone, True)
    force, jacobian = link.force, link.jacobian
    link.release()
    slabs = {}
    for name, order in link.orders(link.rows.order.n_global).items():
        one, expected = whole.arrays()[name]
        slabs[name] = np.ascontiguousarray(one.to_slab(expected)[order.first : order.first + order.count])
    link.load_state(slabs)
    assert link.force.tobytes() == force.tobytes() and link.jacobian.tobytes() == jacobian.tobytes()
    assert list(link.arrays()) == list(whole.arrays()) == list(slabs)
    for name, (order, values) in link.arrays().items():
        assert order.to_slab(values).tobytes() == slabs[name].tobytes()


@pytest.mark.parallel
def test_nothing_is_of_the_size_of_all_rows(ropes, monkeypatch, comm):
    """Ropes along a beam, of which each rank has a piece."""
    monkeypatch.setattr(Ropes, "distant", False)
    sizes = []
    for cells in (10, 20):
        Ropes.part = comm.rank, comm.size
        model = make(comm, names=("ropes",), cells=(cells, 1, 1))
        # each node and the next one: one group, cut where no rank has all of it
        link = model.links
        total = comm.allreduce(int(link.rows.counted.sum()))
        assert total == model.mesh.n_nodes - 1
        sizes.append(len(link.rows.source))
    assert comm.size > 1 or sizes[0] < sizes[1]
    # without groups that reach over ranks, a rank has the rows of its own nodes
    monkeypatch.setattr(Ropes, "distant", True)
    model = make(comm, names=("ropes",), cells=(20, 2, 1))
    link = model.links
    rows = link.rows
    touched = rows.mine[rows.ends].any(axis=1)
    groups = np.unique(rows.group_of_row[touched])
    assert np.isin(rows.group_of_row, groups).all()
    if comm.size == 3:
        total = comm.allreduce(int(rows.counted.sum()))
        assert len(rows.source) < total


@pytest.mark.parallel
def test_parts_of_node_sets_are_the_same_ranges(ropes, comm):
    """Whatever ranks own: sets of one size are divided alike, in ascending order."""
    model = make(comm)
    n = model.mesh.n_nodes
    ids = model.mesh.node_ids[: model.mesh.n_owned]
    for step in (1, 2, 5, n):
        part = _part(model.mesh, np.flatnonzero(ids % step == 0))
        numbers = np.concatenate(comm.allgather(part.numbers))
        assert part.count == len(numbers) and (numbers == np.arange(0, n, step)).all()
        first, last = slab_range(part.count, comm.rank, comm.size)
        assert len(part.numbers) == last - first
        places = np.concatenate(comm.allgather(part.places))
        whole = Model(model.case, MPI.COMM_SELF) if step == 1 and comm.size == 1 else None
        if whole is not None:
            assert (places[whole.mesh.node_ids] == whole.mesh.points).all()


@pytest.mark.parallel
def test_rows_that_contradict_each_other_fail_where_they_are(ropes, comm):
    """A floor above a ceiling: on all ranks that have rows, after all that is collective."""
    walls = ("floor", 1), ("ceiling", -1)
    tables = [f'{{name="{k}", type="plane", point=[0, 0, {0.01 * n}], normal=[0, 0, {n}]}}' for k, n in walls]
    model = make(comm, f"wall=[{', '.join(tables)}]")
    link = model.links
    failed = ""
    try:
        press(model, False)
    except SimulationFailure as failure:
        failed = str(failure)
    assert bool(failed) == (len(link.rows.source) > 0)
    assert "satisfy their contact pairs, constraints, walls and supports" in failed or not failed
