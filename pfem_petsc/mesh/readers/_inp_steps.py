"""The analysis of the first step of an Abaqus input file as tables of a case, and what is left out of the steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh
from ._inp_blocks import Block

__all__ = ["Steps"]

_PROCEDURES = (
    *("STATIC", "DYNAMIC", "FREQUENCY", "BUCKLE", "VISCO", "GEOSTATIC", "SOILS", "ANNEAL", "HEAT TRANSFER"),
    *("COUPLED TEMPERATURE-DISPLACEMENT", "DYNAMIC TEMPERATURE-DISPLACEMENT", "MODAL DYNAMIC", "DIRECT CYCLIC"),
    *("STEADY STATE DYNAMICS", "RESPONSE SPECTRUM", "RANDOM RESPONSE", "COMPLEX FREQUENCY", "MATRIX GENERATE"),
)
_PASSED_OVER = (
    *("HEADING", "PREPRINT", "RESTART", "MONITOR", "CONTROLS", "SURFACE", "ORIENTATION", "PHYSICAL CONSTANTS"),
    *("DISTRIBUTION", "DISTRIBUTION TABLE", "TRANSVERSE SHEAR STIFFNESS", "HOURGLASS STIFFNESS", "TIME POINTS"),
    "DIAGNOSTICS",
)
"""Keywords that do not describe what a truss is or does; those of output are others."""


class Steps:
    """What the keywords say about steps, and which of them are left out."""

    def __init__(self) -> None:
        self._step: Block | None = None
        self._procedure: Block | None = None
        self._later: list[str] = []
        self._left_out: dict[str, None] = {}

    def add(self, block: Block, first: bool) -> None:
        """Note a keyword that is neither mesh nor condition; ``first``: before the end of the first step."""
        keyword = block.keyword
        if not first:
            if keyword in _PROCEDURES:
                self._later.append(f"*{keyword}")
        elif keyword == "STEP":
            self._step = block
        elif self._step is not None and self._procedure is None and keyword in _PROCEDURES:
            self._procedure = block
        elif keyword not in _PASSED_OVER and not {"OUTPUT", "PRINT", "FILE"} & set(keyword.split()):
            self._left_out[f"*{keyword}"] = None

    def finish(self, mesh: WholeMesh, path: object) -> None:
        """Add the table ``analysis`` to a mesh, and warnings about what is left out."""
        if self._left_out:
            mesh.warnings.append(f"{path}: left out {', '.join(self._left_out)}: keywords that are not read")
        if self._later:
            mesh.warnings.append(f"{path}: left out the steps after the first one: {', '.join(self._later)}")
        block = self._procedure
        if block is None:
            return
        try:
            tables, told = _tables(block)
        except InputError as error:
            tables, told = {}, str(error).partition(f"*{block.keyword}: ")[2]
        if tables:
            mesh.tables["analysis"] = tables
        if told:
            mesh.warnings.append(f"{block.where}: {told}")


def _tables(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Return the tables of a case for a procedure, and what is to be said; none for one that the program lacks."""
    if block.keyword == "STATIC":
        return _static(block)
    if block.keyword == "DYNAMIC":
        return _dynamic(block)
    if block.keyword in ("FREQUENCY", "BUCKLE"):
        return _modes(block)
    return {}, f"the first step is left out: the program has no *{block.keyword}"


def _values(block: Block, width: int) -> list[float]:
    """Return the first numbers of the first data line; 0 for those that are missing."""
    rows = block.rows(16, 1)
    row = rows[0] if len(rows) else np.full(16, np.nan)
    return [float(value) if np.isfinite(value) and value > 0.0 else 0.0 for value in row[:width]]


def _static(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Increments over the period are those of the load factor, which goes from 0 to 1."""
    first, period, least, most = _values(block, 4)
    period = period or 1.0
    step = min(first / period, 1.0) if first else 1.0
    keys: dict[str, Any] = {"step": _short(step)}
    if "RIKS" in block.parameters:
        end = _values(block, 5)[4]
        told = "" if end else "end = 1 of the load factor is not in the file: *STATIC, RIKS may end at a displacement"
        return {"static": {"method": "arc_length", **keys, "end": end or 1.0}}, told
    if "DIRECT" not in block.parameters and step < 1.0:
        keys["max_step"] = _short(min(most / period, 1.0)) if most else 1.0
        keys |= {"min_step": _short(least / period)} if 0.0 < least < first else {}
    told = "STABILIZE is left out; see the key static.stabilise" if "STABILIZE" in block.parameters else ""
    return {"static": keys}, told


def _dynamic(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    explicit = "EXPLICIT" in block.parameters
    first, period = _values(block, 2)
    if not period:
        raise InputError(f"{block.where}: the period is missing: the first step is left out")
    if explicit:
        own: float | str = _short(first) if first and "DIRECT USER CONTROL" in block.parameters else "auto"
        return {"time": {"integrator": "central_differences", "step": own, "end": period}}, ""
    step = _short(first) if first else period / 100
    told = f"step = {step:g} s is {'the first increment' if first else 'a hundredth of the period'}, for all steps"
    return {"time": {"integrator": "generalized_alpha", "step": step, "end": period}}, told


def _modes(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Buckling factors are those of the loads of the step, which a static analysis applies."""
    count = _values(block, 1)[0]
    keys: dict[str, Any] = {"count": int(count) if count else 10}
    told = "" if count else "a limit of the frequencies is not supported: modes.count = 10"
    if block.keyword == "FREQUENCY":
        return {"modes": {**keys, "kind": "vibration"}}, told
    return {"static": {"step": 1.0}, "modes": {**keys, "kind": "buckling"}}, told


def _short(value: float) -> float:
    return float(f"{value:.12g}")
