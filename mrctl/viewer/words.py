"""What pages say in words, as lines of HTML: events, gains, arrivals, failures, errors."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrctl.kernel import Array, Rows
from mrctl.loop.goals import arrived
from mrctl.loop.timeline import CHANGEABLE
from mrctl.scenario import Event, Scenario
from mrctl.theory.references import Waypoints
from mrctl.viewer.recording import Recording
from mrctl.viewer.session import Session

RIGID_UNITS = "rad/s per rad/s", "1/s"  # of K_p and K_i of the second channel under rigid steering


def timeline(scenario: Scenario, now: float) -> list[str]:
    """Returns the events of a scenario as lines of HTML; those after the time `now` in s are to come."""
    before: dict[str, Any] = {name: getattr(scenario, name) for name in CHANGEABLE}
    lines = []
    for event in scenario.schedule:
        coming = " (to come)" * (event.time > now)
        lines.append(f"<b>{event.time:.2f} s</b> {html.escape(in_words(event, before))}{coming}")
        before |= {n: v for n in CHANGEABLE if (v := getattr(event, n)) is not None}
    return lines


def in_words(event: Event, before: dict[str, Any]) -> str:
    """Returns an event in words, given the settings before it by the names in `CHANGEABLE`."""
    parts = []
    for name in CHANGEABLE:
        if (new := getattr(event, name)) is not None:
            parts += [
                f"{field.replace('_', ' ')} {_short(getattr(before[name], field))} → {_short(getattr(new, field))}"
                for field in type(new).model_fields
                if getattr(new, field) != getattr(before[name], field)
            ]
    if isinstance(event.reference, Waypoints) and not event.reference.closed:
        parts.append("way to ({:.2f}, {:.2f}) m".format(*event.reference.points[-1]))
    elif event.reference is not None:
        parts.append(f"new reference: {event.reference.kind.replace('_', ' ')}")
    if event.push is not None:
        parts.append("push {:g} N, {:g} N, {:g} N·m".format(*event.push))
    if event.learning is not None:
        parts.append("learning on" if event.learning else "learning off")
    return ", ".join(parts) or "no change"


def _short(value: float | str | None) -> str:
    """Returns a number or a choice as text."""
    return "designed" if value is None else value if isinstance(value, str) else f"{value:g}"


def gains(session: Session) -> list[str]:
    """Returns the present gains of the velocity PID, and how often oscillations have slowed the controllers."""
    rigid = session.start[0].steering == "rigid"
    units = ("V/(m/s)", "V/m"), RIGID_UNITS if rigid else ("V/(rad/s)", "V/rad")
    lines = ["<b>Present gains of the velocity PID</b>"]
    for channel, own, (k_p, k_i) in zip(("common", "second"), session.gains(), units, strict=True):
        lines.append(f"{channel}: K_p {own.k_p:.3g} {k_p}, K_i {own.k_i:.3g} {k_i}")
    if session.oscillations:
        lines.append(f"oscillations of the PID that slowed the controllers: {session.oscillations}")
    return lines


def arrivals(labels: Sequence[str], now: Rows, ends: Sequence[Array | None]) -> list[str]:
    """Returns a line of HTML for each robot that stands at the goal.

    Args:
        labels: Label of each robot.
        now: Record of `TICK` of each robot, `(B,)`.
        ends: Start and goal of each robot, poses in m, m, rad, `(2, 3)`, or None.
    """
    lines = []
    for label, row, bounds in zip(labels, now, ends, strict=True):
        if bounds is not None and arrived(np.array([row["x"], row["y"], row["theta"]]), row["v"], bounds[1]):
            lines.append(f"{html.escape(label)} has arrived")
    return lines


def failures(labels: Sequence[str], recordings: Sequence[Recording]) -> list[str]:
    """Returns lines of HTML on the runs that failed, and on what else went wrong in a run.

    Args:
        labels: Label of each run.
        recordings: The runs.
    """
    lines = []
    for label, run in zip(labels, recordings, strict=True):
        if run.failure:
            lines.append(warning(f"{label} stopped after {run.end:.2f} s: {run.failure}"))
        lines += [warning(f"{label}: {fault}") for fault in run.faults]
    return lines


def warning(text: str) -> str:
    """Returns a text as red HTML."""
    return f'<span style="color:#b91c1c" class="mrctl-error">{html.escape(text)}</span>'


def block(name: str, *lines: str) -> str:
    """Returns lines as an HTML block with the id `mrctl-NAME`."""
    return f'<div style="margin:0.4em 1em;max-height:14em;overflow:auto" id="mrctl-{name}">{"<br>".join(lines)}</div>'
