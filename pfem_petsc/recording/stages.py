"""One history for all stages of a case: the columns of all of them, and sums that go on from stage to stage."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..energies import BAR_ENERGIES, ENERGIES
from ..output.row import Row, RowLayout

if TYPE_CHECKING:
    from .recorder import Recorder

__all__ = ["StageColumns", "StageRows", "accumulates", "carried_sums"]

_WORKS = {energy.name for energy in ENERGIES if energy.source == "ledger"}
_LASTING = ("contact_time", "load_factor")


def accumulates(name: str) -> bool:
    """Whether a column is a sum over the steps that each stage begins at zero."""
    last = name.rsplit("/", 1)[-1]
    return name in _WORKS or last.endswith("impulse") or last == "releases"


class StageColumns:
    """The columns of a case with stages: those of all stages, and ``stage``, the number of the stage from 0.

    Attributes
    ----------
    columns, types : as :class:`~pfem_petsc.recording.recorder.Recorder` has them
    """

    def __init__(self) -> None:
        self.columns: dict[str, tuple[int, ...]] = {"time": (), "step": (), "stage": ()}
        self.types: dict[str, Any] = {"stage": np.int64}

    def add(self, recorder: Recorder) -> None:
        """Add the columns of a stage."""
        self.columns |= recorder.columns
        self.types |= recorder.types

    @cached_property
    def layout(self) -> RowLayout:
        """Of the rows, once the columns of all stages are there."""
        return RowLayout(self.columns, self.types)


class StageRows:
    """Puts the rows of one stage into the columns of all.

    What a stage does not have, such as a wall that is gone, is zero; sums, contact times and the load factor keep their
    values.

    Parameters
    ----------
    columns : StageColumns
    number : of the stage
    layout : of the stage's own rows

    Attributes
    ----------
    rest : (width,) values of the columns that the stage does not have
    """

    def __init__(self, columns: StageColumns, number: int, layout: RowLayout) -> None:
        self.layout = columns.layout
        places = self.layout.places
        self._at = np.concatenate([np.arange(*places[name][:2]) for name in layout.places])
        self.rest = np.zeros(self.layout.width)
        self.rest[places["stage"][0]] = number

    def begin(self, last: Mapping[str, Any]) -> None:
        """Keep what lasts of the last row of the stage before."""
        for name, (first, end, _, _) in self.layout.places.items():
            if accumulates(name) or name.rsplit("/", 1)[-1] in _LASTING:
                self.rest[first:end] = np.ravel(last[name])

    def fill(self, row: Row) -> Row:
        """The row in the columns of all stages."""
        vector = self.rest.copy()
        vector[self._at] = row.vector
        return Row(self.layout, vector)


def carried_sums(recorder: Recorder, last: Mapping[str, Any], kick: tuple[float, np.ndarray]) -> np.ndarray:
    """What a stage adds to its own sums (width of its row,): those of the stages before, and what changed between.

    Energies stay balanced, and momentum that of its impulses. Work and momentum of velocities that the stage adds count
    as external; kinetic energy that is lost, when a static stage or a support stops nodes, as numerical dissipation,
    what supports that begin to move give as external work, momentum that either changes as impulse of supports. What
    other temperatures change at once is thermal work, also together with another prestress, which does prestress work.
    Collective.

    Parameters
    ----------
    recorder : of the stage at its start
    last : row of the end of the stage before, in the columns of all stages
    kick : work [J] and momentum (3,) [N s] of the added velocities
    """
    first, layout = recorder.row(), recorder.layout
    change: dict[str, Any] = {name: np.array(last[name], dtype=float) for name in layout.places if accumulates(name)}
    work, momentum = kick
    gained = first["kinetic_energy"] - last["kinetic_energy"] - work
    change["external_work"] += work + max(gained, 0.0) + first["wall_kinetic_energy"] - last["wall_kinetic_energy"]
    change["numerical_dissipation"] += max(-gained, 0.0)
    case = recorder.model.case
    if "temperature" in case.given or case.stressed:
        # dissipation too: bars may be damaged or break by it at once
        of_bars = [name for name in BAR_ENERGIES if name in layout.places]
        work_of = "thermal_work" if "temperature" in case.given else "prestress_work"
        change[work_of] += sum(first[name] - last[name] for name in of_bars)
    change["external_impulse"] += momentum
    change["support_impulse"] += first["momentum"] - last["momentum"] - momentum
    carried = np.zeros(layout.width)
    for name, value in change.items():
        at, end, _, _ = layout.places[name]
        carried[at:end] = np.ravel(value)
    return carried
