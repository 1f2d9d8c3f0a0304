"""Display names and colours of the controllers, which are the same in figures, scenes and curves."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import cycle

CONTROLLER_FIELDS = ("prior", "learner")
"""Fields of a scenario that choose its controller."""

# Display name and colour, by the name in tables. The first six have colours of Okabe and Ito (2008).
CONTROLLERS: dict[str, tuple[str, str]] = {
    "none": ("PID alone", "#D55E00"),
    "fel": ("PID + network (paper)", "#0072B2"),
    "model+composite": ("PID + model + composite", "#009E73"),
    "model+fel": ("PID + model + network", "#CC79A7"),
    "model": ("PID + model", "#E69F00"),
    "model+rls": ("PID + model + RLS", "#56B4E9"),
    "model+observer": ("PID + model + observer", "#7F6000"),
    "model+mrac": ("PID + model + MRAC", "#8B5CF6"),
    "model+indi": ("PID + model + INDI", "#DB2777"),
    "model+l1": ("PID + model + L1", "#65A30D"),
    "true_model": ("PID + true model", "#475569"),
    "composite": ("PID + composite", "#00664B"),
    "rls": ("PID + RLS", "#219DA6"),
    "mrac": ("PID + MRAC", "#5B21B6"),
}

SHADES = (0.0, 0.45, -0.4, 0.7, -0.65, 0.25, -0.2)
"""Shares by which the curves or robots of one controller differ from its colour."""


def title_of(controller: str) -> str:
    """Returns the display name of a controller; a user's own controller keeps its name."""
    return CONTROLLERS[controller][0] if controller in CONTROLLERS else controller


def colours_of(controllers: Iterable[str]) -> list[str]:
    """Returns a colour for each of several curves or robots, such as `#0072B2`.

    The first curve of a controller has the controller's colour; further ones are lighter or darker. The user's own
    controllers take the colours that none of the others has, in order; when these run out, colours repeat.
    """
    controllers = list(controllers)
    names = list(dict.fromkeys(controllers))
    palette = [colour for _, colour in CONTROLLERS.values()]
    taken = {CONTROLLERS[name][1] for name in names if name in CONTROLLERS}
    free = cycle([colour for colour in palette if colour not in taken] or palette)
    own = {name: CONTROLLERS[name][1] if name in CONTROLLERS else next(free) for name in names}
    before, found = dict.fromkeys(names, 0), []
    for name in controllers:
        found.append(_shaded(own[name], SHADES[before[name] % len(SHADES)]))
        before[name] += 1
    return found


def _shaded(colour: str, lighter: float) -> str:
    """Returns a colour nearer to white, or for a negative share nearer to black."""
    if not lighter:
        return colour
    end = 255 if lighter > 0 else 0
    parts = (round(c + abs(lighter) * (end - c)) for c in bytes.fromhex(colour.removeprefix("#")))
    return f"#{bytes(parts).hex().upper()}"
