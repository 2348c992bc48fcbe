"""Probes of a row: each rank has and sends the numbers of its own nodes, and the row has those of all."""

from types import SimpleNamespace

import numpy as np
import pytest

from pfem_petsc.run.recorder import Probes


@pytest.mark.parallel
def test_ranks_send_their_own_nodes_and_rows_have_all(comm):
    ids = np.random.default_rng(4).permutation(40)
    own = ids[ids % comm.size == comm.rank]
    every = np.arange(len(own))
    # the nodes of the second are on the last rank, and a node is in two probes
    sets = {"low": every[own < 11], "last": every[(own % comm.size == comm.size - 1) & (own < 9)], "none": every[:0]}
    probes = Probes(comm, sets, own)
    assert probes.ids["low"].tolist() == list(range(11))
    assert probes.size == 12 * (len(sets["low"]) + len(sets["last"]))
    place = own[:, None] + np.array([0.1, 0.2, 0.3])
    state = SimpleNamespace(x=place, v=-place, contact=place)
    share, row = np.full(probes.size, np.nan), np.full(probes.width, np.nan)
    probes.fill(share, state, 5.0 * place, 2.0 * place)
    # compiled loops write vectors of a node one after the other
    assert np.array_equal(share.reshape(-1, 12)[:, :3], place[probes.nodes])
    assert np.array_equal(probes.places(), 12 * np.arange(len(probes.nodes)))
    probes.unite(share, row)
    expected = []
    for numbers in probes.ids.values():
        values = numbers[:, None] + np.array([0.1, 0.2, 0.3])
        expected += [np.stack([values, -values, 5.0 * values, 3.0 * values]).ravel()]
    assert row == pytest.approx(np.concatenate(expected), rel=1e-15)
