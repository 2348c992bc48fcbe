"""Computes, reports and writes the modes of the state at the end of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..modes.find import Found, find_modes
from ..modes.members import weakest_member
from ..output.modes import NAMES
from ..output.units import MODE
from ..output.vtkhdf import ResultWriter
from ..parallel.agreement import on_root

if TYPE_CHECKING:
    from ..output.progress import Progress
    from ..stepping.stepper import Stepper

__all__ = ["MODES_FILE", "record_modes", "remove_modes"]

MODES_FILE = "modes.vtkhdf"
_PER_LINE = 5


def record_modes(stepper: Stepper, writer: ResultWriter, folder: Path, progress: Progress) -> None:
    """Find the modes of the stepper's state, write and report them. Collective.

    Raises
    ------
    PfemError
        On all ranks.
    """
    model, settings = stepper.model, stepper.model.case.modes
    consistent = (settings.mass or model.case.mass) == "consistent"
    found = find_modes(model, stepper.state, settings, consistent)
    writer.write_modes(found.eigenvalues, found.values, found.shapes)
    _write_file(stepper, found, folder)
    for text in _told(found, settings.count):
        progress.message(text)
    if found.kind == "buckling":
        _tell_members(stepper, found, progress)
    if found.negative:
        are = "eigenvalues are" if found.negative > 1 else "eigenvalue is"
        progress.warning(
            f"unstable equilibrium: {found.negative} {are} negative: such a motion grows as exp(2 pi |f| t); its "
            "frequency is given as -|f|"
        )


def _tell_members(stepper: Stepper, found: Found, progress: Progress) -> None:
    """Report the first bar that buckles as a column, which the factors of the truss do not contain. Collective."""
    weakest = weakest_member(stepper.model, stepper.state.x)
    if weakest is None:
        return
    factor, bar = weakest
    text = (
        f"bar {bar} is the first that buckles as a column, at the factor {factor:.6g} (pi^2 E I/(K L)^2 over its force)"
    )
    if not len(found.values) or factor < found.values[0]:
        progress.warning(f"{text}, before the truss does: its factors are for bars that stay straight")
    else:
        progress.message(text)


def _told(found: Found, asked: int) -> list[str]:
    name, unit = NAMES[found.kind]
    head = "natural frequencies" if found.kind == "vibration" else "buckling: factors of the axial forces"
    lines = [f"modes by {found.solver}"]
    if found.at_walls:
        lines.append(
            f"{found.at_walls} nodes are held by walls that press on them: along the normals, by friction and ties in "
            "all directions"
        )
    zeros = int((found.eigenvalues == 0.0).sum())
    if zeros:
        lines.append(f"{zeros} frequencies are zero: rigid-body motions or mechanisms, which no stiffness resists")
    if len(found.values) < asked:
        lines.append(f"{asked} modes are requested, but the state has {len(found.values)}")
    for first in range(0, len(found.values), _PER_LINE):
        numbers = "  ".join(f"{value:.6g}" for value in found.values[first : first + _PER_LINE])
        last = min(first + _PER_LINE, len(found.values))
        which = f"{first + 1}-{last}" if last > first + 1 else f"{last}"
        lines.append(f"{head} {which}: {numbers} {unit}".rstrip())
    return lines


def _write_file(stepper: Stepper, found: Found, folder: Path) -> None:
    """Write a separate file for ParaView, with one step per mode, whose time is the number of the mode. Collective."""
    model, state = stepper.model, stepper.state
    name, _ = NAMES[found.kind]
    columns = {"time": (), "step": (), name: (), "eigenvalue": ()}
    case = model.case
    with ResultWriter(
        folder / MODES_FILE,
        model.comm,
        model.mesh,
        point_fields=["displacement", name],
        cell_fields=[],
        columns=columns,
        column_types={"step": np.int64},
        case_text=case.to_toml(),
        attributes={"name": case.name, "folder": str(case.folder.resolve()), "kind": found.kind, "axis": MODE.symbol},
    ) as writer:
        for k, (value, eigenvalue) in enumerate(zip(found.values, found.eigenvalues, strict=True)):
            row = {"time": float(k + 1), "step": k + 1, name: value, "eigenvalue": eigenvalue}
            writer.append_history(row if model.comm.rank == 0 else None)
            fields = {"displacement": found.shapes[k], name: np.full(len(state.position), value)}
            writer.write_snapshot(float(k + 1), k + 1, state.position, fields, {})


def remove_modes(folder: Path, comm: object) -> None:
    """Remove the file of modes of a continued run, which do not belong to its new end. Collective."""
    on_root(comm, (folder / MODES_FILE).unlink, True)
