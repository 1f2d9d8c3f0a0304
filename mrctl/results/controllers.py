"""Display names and colours of the controllers, which are the same in figures, scenes and curves."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count

CONTROLLER = ("prior", "learner")
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
    "rls": ("PID + RLS", "#2E7BA6"),
    "mrac": ("PID + MRAC", "#5B21B6"),
}


def title_of(controller: str) -> str:
    """Returns the display name of a controller; a user's own controller keeps its name."""
    return CONTROLLERS[controller][0] if controller in CONTROLLERS else controller


def colours_of(controllers: Iterable[str]) -> list[str]:
    """Returns a colour for each of several curves or robots, such as `#0072B2`.

    The first curve of a controller has the controller's colour. Further ones, and those of the user's own controllers,
    take the free colours in order; when these run out, colours repeat.
    """
    controllers = list(controllers)
    palette = [colour for _, colour in CONTROLLERS.values()]
    own = {name: row for row, name in reversed(list(enumerate(controllers))) if name in CONTROLLERS}
    taken = {CONTROLLERS[name][1] for name in own}
    free = [colour for colour in palette if colour not in taken] or palette
    others = count()
    return [
        CONTROLLERS[name][1] if own.get(name) == row else free[next(others) % len(free)]
        for row, name in enumerate(controllers)
    ]
