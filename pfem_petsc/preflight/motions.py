"""Check of motions of supports and walls with velocity jumps."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.plan import Plan

__all__ = ["jumping_motions"]


def jumping_motions(case: Case, plan: Plan) -> list[str]:
    """Warn about linear interpolation with a scheme that does not damp the vibrations by its velocity jumps."""
    if plan.scheme.dissipates:
        return []
    moved = [(f"support[{k}]", entry) for k, entry in enumerate(case.support)]
    moved += [(f"wall {entry.name!r}", entry) for entry in case.wall]
    return [
        f'{name}: with interpolation = "linear" the velocity jumps at each of the {len(entry.motion)} rows of motion, '
        f"and {case.time.integrator} with these parameters preserves the vibrations that this causes; use "
        'interpolation = "smooth", or a scheme with numerical dissipation'
        for name, entry in moved
        if entry.interpolation == "linear"
    ]
