"""Colours of what is drawn in addition to coloured bars, told apart with any colour vision (Okabe and Ito, 2008)."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["GHOST", "MARKS", "TRAILS"]


class Mark(NamedTuple):
    """How bars in a state are marked: by the field that tells, with a colour, and its text below the picture."""

    field: str
    colour: tuple[int, int, int]
    text: str


GHOST = (168, 176, 188)
MARKS = {
    "broken": Mark("status", (0, 0, 0), "broken"),
    "yielded": Mark("plastic_strain", (240, 200, 30), "yielded"),
}
TRAILS = ((0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0))
