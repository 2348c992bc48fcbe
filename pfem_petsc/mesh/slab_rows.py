"""Bars added to a mesh before its distribution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from .exchange import Router
from .slab import MeshSlab, slab_of, slab_range

__all__ = ["with_bars"]


def with_bars(
    slab: MeshSlab,
    comm: MPI.Comm,
    ends: np.ndarray,
    sections: np.ndarray,
    new_sections: np.ndarray,
    field: tuple[str, np.ndarray],
) -> tuple[MeshSlab, np.ndarray]:
    """Return a slab with further bars after those of the mesh, and the section of each of its bars. Collective.

    Parameters
    ----------
    ends : (m, 2) mesh numbers of the nodes of the new bars, the same on all ranks
    sections : (bars here,) of the bars of the slab; new_sections : (m,) of the new ones
    field : name and values (m,) of a further field of the bars; it is zero for the others
    """
    total = slab.n_bars + len(ends)
    numbers = slab.first_bar + np.arange(len(slab.bars), dtype=np.int64)
    # contiguous ranges arrive in order, and the new bars are the last ones
    router = Router(comm, slab_of(numbers, total, comm.size))
    first, last = slab_range(total, comm.rank, comm.size)
    own = slice(max(first - slab.n_bars, 0), max(last - slab.n_bars, 0))
    name, values = field
    fields = {key: np.concatenate([router.send(old), np.zeros(len(ends[own]))]) for key, old in slab.bar_fields.items()}
    fields[name] = np.concatenate([np.zeros(router.n_received), values[own]])
    groups = {
        key: Router(comm, slab_of(members, total, comm.size)).send(members) for key, members in slab.bar_groups.items()
    }
    made = replace(
        slab,
        n_bars=total,
        first_bar=first,
        bars=np.concatenate([router.send(slab.bars), ends[own].astype(slab.bars.dtype)]),
        bar_groups=groups,
        bar_fields=fields,
    )
    return made, np.concatenate([router.send(sections), new_sections[own]]).astype(np.int32)
