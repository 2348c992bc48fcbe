"""Contact times with few rows of the history: bounded memory and equal sums."""

from types import SimpleNamespace

import numpy as np
import pytest

from pfem_petsc.contact import node_walls as logs
from pfem_petsc.contact.node_walls import ContactLog

pytestmark = pytest.mark.parallel


def walls(contacts):
    """Forces of a step in which this rank has so many nodes on each wall."""
    n = len(contacts)
    nodes, touching = np.empty(0, np.int64), np.zeros((0, n), bool)
    return SimpleNamespace(contacts=np.array(contacts), nodes=nodes, touching=touching, force=np.zeros((n, 3)))


def booked(log, comm, steps, start=0):
    """Two walls: one that a rank touches at a time in turn with none, one that only the last rank touches."""
    for i in range(start, steps):
        turn = i % (comm.size + 1)
        log.book(walls([3 * (turn == comm.rank), (i % 5 == 0) * (comm.rank == comm.size - 1)]), 1.0 + 0.25 * i, comm)
    return log


def expected(comm, steps):
    i = np.arange(steps)
    lengths = 1.0 + 0.25 * i
    return lengths[i % (comm.size + 1) < comm.size].sum(), lengths[i % 5 == 0].sum()


def test_pending_steps_come_back_from_a_checkpoint(comm, monkeypatch):
    """Also on other numbers of ranks: all have what any has."""
    monkeypatch.setattr(logs, "_PENDING", 40)
    whole, stopped, again = (ContactLog(7, 2) for _ in range(3))
    booked(whole, comm, 167).meet(comm)
    booked(stopped, comm, 99)
    share, times = stopped.share(), stopped.times(comm)
    again.load_state(share, times, np.zeros((7, 2), bool))
    assert len(times["steps"]) == 19
    booked(again, comm, 167, start=99).meet(comm)
    assert again.time.tobytes() == whole.time.tobytes()
    # multiples of a quarter: exact in any order
    np.testing.assert_array_equal(whole.time, expected(comm, 167))
