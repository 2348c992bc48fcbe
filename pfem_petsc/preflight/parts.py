"""Disconnected parts of a truss."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel
from ..mesh.exchange import Router
from ..mesh.slab import slab_of

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["count_parts"]


@kernel
def _spread(bars, label):
    """Assign the lower label to both ends of each bar until nothing changes, in forward and backward sweeps."""
    changed = True
    while changed:
        changed = False
        for sweep in range(2):
            for i in range(len(bars)):
                k = i if sweep == 0 else len(bars) - 1 - i
                a = label[bars[k, 0]]
                b = label[bars[k, 1]]
                if a < b:
                    label[bars[k, 1]] = a
                    changed = True
                elif b < a:
                    label[bars[k, 0]] = b
                    changed = True


def count_parts(mesh: DistributedMesh) -> tuple[int, int, int]:
    """Return the number of connected parts, and the size and lowest node number of the smallest one. Collective.

    Every node gets the lowest mesh number that it is connected to: within a rank by compiled sweeps, between ranks by
    the exchange of ghosts, repeated until no rank changes anything.
    """
    comm, owned = mesh.comm, mesh.n_owned
    label = mesh.node_ids[: mesh.n_local].astype(np.float64).reshape(-1, 1)  # whole numbers, exact to 2^53
    while True:
        before = label[:owned].copy()
        _spread(mesh.bars, label[:, 0])
        mesh.update_ghosts(label)
        # a ghost may have a lower number, and this rank's own numbers may still have to propagate
        if comm.allreduce(int(not np.array_equal(before, label[:owned])), op=MPI.MAX) == 0:
            break
    names, sizes = np.unique(label[:owned, 0].astype(np.int64), return_counts=True)
    # a rank adds up the parts whose lowest node is in its range of the mesh numbers, however many there are
    router = Router(comm, slab_of(names, mesh.n_nodes, comm.size))
    received, shares = router.send(names), router.send(sizes)
    own, places = np.unique(received, return_inverse=True)
    total = np.bincount(places.ravel(), weights=shares, minlength=len(own))
    at = int(np.argmin(total)) if len(own) else -1
    mine = (int(total[at]), int(own[at])) if len(own) else (mesh.n_nodes + 1, -1)
    smallest, name = min(comm.allgather(mine))
    return comm.allreduce(len(own)), smallest, name
