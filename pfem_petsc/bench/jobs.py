"""The measurements of the bench."""

from __future__ import annotations

from .cases import PITCH, WAVE_SPEED, Job

__all__ = ["NAMES", "jobs", "tiny_jobs"]

NAMES = ("explicit", "explicit_contact", "matrix_free", "assembled", "implicit_contact")
"""Names of the jobs, for the command line."""

_CROSSING = PITCH / WAVE_SPEED  # [s] of a wave along the edge of a cell


def jobs(
    names: list[str], explicit: str, implicit: str, mass: str, plastic: bool | None, history_every: int
) -> list[Job]:
    """Return the jobs of these names.

    Parameters
    ----------
    names : of :data:`NAMES`
    explicit, implicit : integrators
    mass : ``lumped`` or ``consistent``
    plastic : whether bars can yield; None: in the explicit impact only
    history_every : steps between rows of the history
    """

    def make(name: str) -> Job:
        yields = name == "explicit_contact" if plastic is None else plastic
        common = {"mass": mass, "plastic": yields, "history_every": history_every}
        if name == "explicit":
            return Job(name, explicit, step=0.1 * _CROSSING, **common)
        if name == "explicit_contact":
            # short steps: thousands of them before the lattice leaves the floor
            return Job(name, explicit, contact=True, step=0.02 * _CROSSING, **common)
        if name == "implicit_contact":
            return Job(name, implicit, operator="matrix_free", contact=True, step=2.0 * _CROSSING, **common)
        return Job(name, implicit, operator=name, linear="cg", step=2.0 * _CROSSING, **common)

    return [make(name) for name in names]


def tiny_jobs(explicit: str) -> list[Job]:
    """Return jobs with so few bars that the measured time is the cost of a step outside the loops over bars."""
    step = 0.02 * _CROSSING
    return [
        Job("tiny", explicit, step=step),
        Job("tiny, history every 10", explicit, step=step, history_every=10),
        Job("tiny, contact", explicit, contact=True, step=0.1 * step),
    ]
