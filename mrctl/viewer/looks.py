"""Labels and colours of a page, most of which identify its robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mrctl.results.controllers import colours_of

Colour = tuple[int, int, int]
EVENT_COLOUR: Colour = (128, 134, 146)  # grey, which neither PID alone nor a learner has
MAX_MARKED = 4  # number of robots whose estimates and targets are drawn


class Look(NamedTuple):
    """The label of a robot and its colour in the scene and in the curves."""

    label: str
    colour: Colour


def looks(labels: Sequence[str], controllers: Sequence[str]) -> list[Look]:
    """Returns the look of each robot, whose colour is that of its controller in figures too."""
    return [Look(label, _rgb(colour)) for label, colour in zip(labels, colours_of(controllers), strict=True)]


def told_apart(names: Sequence[str], numbers: Sequence[int]) -> list[str]:
    """Returns names, such as labels, each with its number if any two are equal."""
    if len(set(names)) == len(names):
        return list(names)
    return [f"{name} {number}" for name, number in zip(names, numbers, strict=True)]


def pale(colour: Colour) -> Colour:
    """Returns the colour of what a robot with a colour estimates or considers."""
    red, green, blue = (255 - (255 - c) // 2 for c in colour)
    return red, green, blue


def _rgb(colour: str) -> Colour:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
