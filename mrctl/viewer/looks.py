"""Labels and colours that identify the robots of a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mrctl.results.controllers import colours_of

Colour = tuple[int, int, int]
LIGHTER = (0.0, 0.45, -0.4, 0.7, -0.65)  # shares by which robots with one controller differ from its colour


class Look(NamedTuple):
    """The label of a robot and its colour in the scene and in the curves."""

    label: str
    colour: Colour


def looks(labels: Sequence[str], controllers: Sequence[str]) -> list[Look]:
    """Returns the look of each robot, whose colour is that of its controller in figures too.

    Robots with one controller differ in lightness.
    """
    names = list(dict.fromkeys(controllers))
    own, before = dict(zip(names, map(_rgb, colours_of(names)), strict=True)), dict.fromkeys(names, 0)
    found = []
    for label, name in zip(labels, controllers, strict=True):
        found.append(Look(label, _shaded(own[name], LIGHTER[before[name] % len(LIGHTER)])))
        before[name] += 1
    return found


def _shaded(colour: Colour, lighter: float) -> Colour:
    """Returns a colour nearer to white, or for a negative share nearer to black."""
    end = 255 if lighter > 0 else 0
    red, green, blue = (round(c + abs(lighter) * (end - c)) for c in colour)
    return red, green, blue


def pale(colour: Colour) -> Colour:
    """Returns the colour of what a robot with a colour estimates or considers."""
    red, green, blue = (255 - (255 - c) // 2 for c in colour)
    return red, green, blue


def _rgb(colour: str) -> Colour:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
