"""Bars whose strain, stress and axial force are in each row of the history."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..columns import OF_BARS
from ..errors import InputError
from ..mesh.distribution import bars_of_group

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import BarProbe
    from ..mesh.distribution import DistributedMesh
    from .bars import Bars


class ProbedBars:
    """The bars of all ``[[output.bar_probe]]``. Construction is collective.

    A row has them by probe, by quantity of :data:`~pfem_petsc.columns.OF_BARS`, and by mesh number. Each bar is counted
    on one rank, so that the sum of the ranks' shares is the row's values.

    Attributes
    ----------
    ids : name of a probe to the mesh numbers of its bars on all ranks, ascending
    width : numbers of all probes in a row

    Raises
    ------
    InputError
        On all ranks, for a group that the mesh does not have, a number out of range, or a probe without bars.
    """

    def __init__(self, case: Case, mesh: DistributedMesh) -> None:
        self.ids: dict[str, np.ndarray] = {}
        self.width = 0
        counted = np.arange(len(mesh.bars))[mesh.counted]
        local, places = [np.empty(0, dtype=np.int64)], [np.empty((len(OF_BARS), 0), dtype=np.int64)]
        for number, probe in enumerate(case.output.bar_probe):
            chosen = np.intersect1d(_chosen(case, mesh, f"output.bar_probe[{number}]", probe, counted), counted)
            ids = np.sort(np.concatenate(mesh.comm.allgather(mesh.bar_ids[chosen].astype(np.int64))))
            if not len(ids):
                raise InputError(f"{case.source}: output.bar_probe[{number}].bars = {str(probe.bars)!r}: has no bars")
            local.append(chosen)
            order = np.searchsorted(ids, mesh.bar_ids[chosen])
            places.append(self.width + np.arange(len(OF_BARS))[:, None] * len(ids) + order)
            self.ids[probe.name] = ids
            self.width += len(OF_BARS) * len(ids)
        self._local, self._places = np.concatenate(local), np.hstack(places)

    def fill(self, bars: Bars, x: np.ndarray, share: np.ndarray) -> None:
        """Write the values of the bars that are counted on this rank to its share (width,), at positions ``x``."""
        if len(self._local):
            share[self._places] = bars.axial(x)[:, self._local]


def _chosen(case: Case, mesh: DistributedMesh, key: str, probe: BarProbe, counted: np.ndarray) -> np.ndarray:
    """Return the local bars of a probe, with those that other ranks count. Collective."""
    if probe.bars is not None:
        return bars_of_group(case, mesh, f"{key}.bars", str(probe.bars))
    ids = mesh.bar_ids[counted]
    if probe.indices is not None:
        last = mesh.n_bars - mesh.n_connectors - 1
        outside = [number for number in probe.indices if number > last]
        if outside:
            raise InputError(
                f"{case.source}: {key}.indices: bar {outside[0]} does not exist; the mesh has bars 0 to {last}"
            )
        return counted[np.isin(ids, probe.indices)]
    real = counted[ids < mesh.n_bars - mesh.n_connectors]
    middles = mesh.points[mesh.bars[real]].mean(axis=1)
    distance = np.linalg.norm(middles - np.array(probe.nearest), axis=1)
    shortest = mesh.comm.allreduce(float(distance.min(initial=np.inf)), op=MPI.MIN)
    nearest = real[distance == shortest]
    first = mesh.comm.allreduce(int(mesh.bar_ids[nearest].min(initial=mesh.n_bars)), op=MPI.MIN)
    return nearest[mesh.bar_ids[nearest] == first]
