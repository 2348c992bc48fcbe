"""Walls and constraints of users that fail during a run: told on all ranks, and NaN is no satisfied condition."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, registry
from pfem_petsc.errors import InputError, SimulationFailure

WALL = """
import numpy as np
from pfem_petsc.contact.walls.base import BaseWall, WallKeys

class Parameters(WallKeys):
    pass

class Wall(BaseWall):
    def __init__(self, parameters):
        self.centre = np.zeros(3)

    def planes(self, x):
        normals, offsets = np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.full(len(x), -1.0)
        low = x[:, 2] < -0.01
        if low.any():
            {body}
        return normals, offsets
"""
TETHER = """
import numpy as np
from pfem_petsc.contact.constraints.base import Constraint as Base, ConstraintKeys, NodeSetName

class Parameters(ConstraintKeys):
    node_set: NodeSetName

class Constraint(Base):
    def __init__(self, parameters, nodes_of):
        self.nodes = nodes_of(parameters.node_set).numbers[:, None]

    def values(self, x):
        z = x[:, 0, 2]
        low = z < -0.01
        if low.any():
            {body}
        return z + 1.0

    def gradients(self, x):
        return np.tile([0.0, 0.0, 1.0], (len(x), 1, 1))
"""
SEARCH = """
import numpy as np
from mpi4py import MPI
from pfem_petsc.contact.constraints.base import Constraint as Base, ConstraintKeys
from pfem_petsc.errors import SimulationFailure

class Parameters(ConstraintKeys):
    pass

class Constraint(Base):
    dynamic = True

    def __init__(self, parameters, nodes_of):
        self.nodes, self.data = np.empty((0, 1), dtype=np.int64), np.empty((0, 0))
        self.ids = np.empty(0, dtype=np.int64)

    def find(self, nodes):
        if nodes.time > 0.02 and nodes.comm.rank == nodes.comm.size - 1:
            {body}
        return self

    def values(self, x):
        return np.empty(len(x))

    def gradients(self, x):
        return np.zeros_like(x)
"""


@pytest.fixture
def run(comm, shared_tmp_path, own_registry):
    """Run a rod that falls, with a plugin of some code; several ranks own a part of it."""

    def run_rod(code: str, scheme: str, *, on=comm, **tables) -> None:
        path = shared_tmp_path / "odd.py"
        if comm.rank == 0:
            path.write_text(code)
        comm.Barrier()
        registry.add_plugin(path)
        data = {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 6},
            "node_set": {"all": {"all": True}, "end": {"group": "end"}},
            "material": {"m": {"young_modulus": 100.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "initial": {"velocity": [0.0, 0.0, -1.0]},
            "time": {"integrator": scheme, "step": 1e-3, "end": 0.05},
            "output": {"fields_every": 0},
            **tables,
        }
        with Simulation(Case.from_dict(data), on, output=shared_tmp_path / "out", quiet=True) as simulation:
            simulation.run()

    return run_rod


ODD = [{"name": "odd", "type": "odd"}]
CONSTRAINED = [{"name": "rope", "kind": "odd", "node_set": "end"}]


@pytest.mark.parallel
@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("offsets[low] = np.nan", r"planes returned nan at \[.*, -0.01\S*\]: it must return numbers"),
        ("normals[low] = np.nan", r"planes returned \[nan, nan, nan\] at \[.*, -0.01\S*\]"),
        ("raise ZeroDivisionError('no plane')", r"planes raised ZeroDivisionError: no plane \(.*odd.py, line \d+\)"),
    ],
)
def test_walls(body, told, comm, run):
    """Also where the node belongs to one rank only."""
    if comm.size > 1:
        body = f"from mpi4py import MPI\n            if MPI.COMM_WORLD.rank == 1:\n                {body}"
    with pytest.raises(SimulationFailure, match=rf"step \d+, t = .* s: wall 'odd': .*{told}"):
        run(WALL.format(body=body), "central_differences", wall=ODD)


@pytest.mark.parallel
@pytest.mark.parametrize("body", ["z = z * np.where(low, np.nan, 1.0)", "raise ZeroDivisionError('no value')"])
def test_constraints(body, run):
    told = "returned nan at .*: it must" if "nan" in body else r"raised ZeroDivisionError: no value \(.*, line \d+\)"
    with pytest.raises(SimulationFailure, match=rf"step \d+, t = .* s: constraint 'rope': values {told}"):
        run(TETHER.format(body=body), "central_differences", constraint=CONSTRAINED)


@pytest.mark.parametrize("scheme", ["newmark", "chung_lee"])
def test_other_schemes(scheme, run):
    with pytest.raises(SimulationFailure, match=r"wall 'odd': .*planes returned nan"):
        run(WALL.format(body="offsets[low] = np.nan"), scheme, on=MPI.COMM_SELF, wall=ODD)
    tether = TETHER.format(body="z = z * np.where(low, np.nan, 1.0)")
    with pytest.raises(SimulationFailure, match="constraint 'rope': values returned nan at"):
        run(tether, scheme, on=MPI.COMM_SELF, constraint=CONSTRAINED)


@pytest.mark.parallel
def test_start(run):
    """At the start they are invalid input."""
    initial = [[0.0, 0.0, -0.02], [1.0, 0.0, -0.02]]
    mesh = {"generator": "arrays", "points": initial, "bars": [[0, 1]], "node_groups": {"end": [1]}}
    with pytest.raises(InputError, match=r"constraint 'rope': values returned nan at"):
        run(TETHER.format(body="z = z * np.nan"), "central_differences", constraint=CONSTRAINED, mesh=mesh)
    with pytest.raises(InputError, match=r"wall 'odd': .*planes returned the normal .* and the offset nan at"):
        run(WALL.format(body="offsets[low] = np.nan"), "central_differences", wall=ODD, mesh=mesh)


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
@pytest.mark.parametrize("error", ["SimulationFailure('no rows')", "ZeroDivisionError('no rows')"])
def test_search_of_one_rank(error, scheme, run, comm):
    """A constraint whose rows come and go: what ``find`` raises on the last rank, all ranks raise."""
    own = comm.size == 1 and "Zero" in error
    told = "no rows"
    if not own and "Zero" in error:
        told = "constraint 'rope': find: the function raised ZeroDivisionError: no rows .* on rank"
    constraint = [{"name": "rope", "kind": "odd"}]
    with pytest.raises(ZeroDivisionError if own else SimulationFailure, match=told):
        run(SEARCH.format(body=f"raise {error}"), scheme, constraint=constraint)
