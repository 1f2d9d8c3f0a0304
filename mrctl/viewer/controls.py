"""Inputs of a page, made from the fields of a record of settings and their limits."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import floor, isfinite, log10
from typing import Any, Literal

import viser
from annotated_types import Ge, Gt, Le, Lt
from pydantic.fields import FieldInfo

from mrctl.record import Record, bounds, with_limits
from mrctl.sensing.tiers import START, TIER_VALUES, Sensing
from mrctl.theory.robot import Robot
from mrctl.viewer.slider_ranges import Interval, slider_range

OnChange = Callable[[tuple[str, ...], Any], None]
WORLDS = ("flat", "slope", "rough", "patch")
SENSORS = {"encoders": "encoder", "gyro": "gyro", "accelerometer": "accelerometer", "posture fixes": "fix"}
DRIVER = ("dead_zone", "pwm_steps", "current_limit", "battery_resistance")
MAP_FIELDS = ("localisation", "lidar", "start_unknown")  # fields without an input, as they need obstacles, in a file
PLAN_FIELDS = ("start_speed", "start_curvature", "end_curvature", "cusp_curvatures")  # nor have these, which plans set
NEW_RUN_MARK, NEW_RUN_HINT = " ↻", "A change begins another run."  # behind the label of what cannot change during a run
SEED_FIELDS = ("seed",)  # a number that no slider suits
STEERING = ("steering_offset", "steering_backlash")
# The unit of a number in its description, and what ends the part of that which is about its value.
UNIT = re.compile(r" in (1/\(V² s\)|(?:1/)?(?:kg|m|s|rad|V|A|Ω|Hz)(?![a-z])[/√²a-zH]*(?: √s| per rad/s)?)")
ASIDE = re.compile(r"\. |; | \(")
# Fields of large records in groups, by the name of the field that holds the record. The first group of a perturbation
# is open; fields without a group stand above the groups.
GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "perturbation": {
        "mass and payload": ("mass_factor", "inertia_factor", "payload", "payload_x", "payload_y", "payload_z"),
        "motors": tuple(
            f"{side}{name}_factor"
            for side in ("", "left_", "right_")
            for name in ("drive_friction", "resistance", "motor_constant")
        ),
        "driver and battery": ("supply_factor", *DRIVER, "control_delay"),
        "steering": STEERING,
        "wheels and ground": (
            "left_radius_factor",
            "right_radius_factor",
            "tyre_friction_factor",
            "left_tyre_friction_factor",
            "slope",
        ),
    },
    "sensing": {
        group: tuple(name for name in TIER_VALUES if name.startswith(f"{sensor}_")) for group, sensor in SENSORS.items()
    }
    | {"driver and battery": ("delay", *DRIVER), "steering": STEERING},
}


class Controls:
    """One input for every number, choice or switch of a record; records inside it become folders.

    A record that comes in several kinds has a folder for each kind, of which only that of the present kind is visible.
    No folder is ever removed: a slow browser applies several messages at once, removals first, and then reports errors
    for messages to what it has removed.

    The input of a field that is not set and follows from the design shows the designed value, and its label says so; a
    field that is set has a button that returns it to the design.

    A slider shows the range that suits the present robot. A number that is typed beyond its ends is accepted up to the
    limits of the record, and moves an end there until the value is within that range again.

    Attributes:
        designed: Values by path, in the units of the fields, that fields have while they are not set; those that have
            no effect at present are None and hidden. Whoever adds or shows a record sets them before.
    """

    def __init__(self, gui: viser.GuiApi, on_change: OnChange, robot: Robot, changeable: Sequence[str] = ()) -> None:
        """Takes what inputs need.

        Args:
            gui: GUI of the page.
            on_change: Function that receives the path and the new value of a changed field.
            robot: Parameters of the robot.
            changeable: First names in paths of fields that can change during a run; the labels of others are marked.
        """
        self._gui, self._on_change, self._changeable = gui, on_change, changeable
        self._robot = robot
        self._limits: dict[tuple[str, ...], Interval] = {}  # of the record
        self._sliders: dict[tuple[str, ...], tuple[FieldInfo, Interval]] = {}  # and the range of the slider
        self._inputs: dict[tuple[str, ...], Any] = {}
        self._labels: dict[tuple[str, ...], str] = {}  # of numbers that follow from the design, when they are set
        self._folders: dict[tuple[str, ...], viser.GuiFolderHandle] = {}
        self._buttons: dict[tuple[str, ...], viser.GuiButtonHandle] = {}
        self._records: dict[str, viser.GuiFolderHandle] = {}  # folders of the fields that are records, by first name
        self._hidden: set[str] = set()
        self.designed: Mapping[tuple[str, ...], float | None] = {}

    def add(self, record: Record, path: tuple[str, ...] = (), only: Sequence[str] | None = None) -> None:
        """Adds inputs in the present context of the GUI.

        Args:
            record: Present values.
            path: Names of the fields that lead to the record.
            only: Names of the fields that get an input; by default all.
        """
        groups = GROUPS.get(path[-1], {}) if path else {}
        grouped = [name for names in groups.values() for name in names]
        for name, field in type(record).model_fields.items():
            if name not in (*grouped, *MAP_FIELDS, *PLAN_FIELDS) and (only is None or name in only):
                self._add(self._shown(record, (*path, name)), field, (*path, name))
        for group, names in groups.items():
            with self._gui.add_folder(group, expand_by_default=group == "mass and payload"):
                for name in names:
                    self._add(self._shown(record, (*path, name)), type(record).model_fields[name], (*path, name))

    def _add(self, value: Any, field: FieldInfo, path: tuple[str, ...]) -> None:  # noqa: ANN401
        label, hint = self._label(path, field), self._hint(path, field)
        if isinstance(value, Record):
            with self._gui.add_folder(_words(path), expand_by_default=len(path) == 1) as folder:
                if len(path) == 1:
                    self._records[path[0]] = folder
                if not (kinds := _kinds(field)):
                    return self.add(value, path)
                kind = type(value).model_fields["kind"].default
                choice = self._gui.add_dropdown(
                    self._label((*path, "kind")), tuple(kinds), initial_value=kind, hint=hint
                )
                self._listen(path, choice)
                for name, alternative in kinds.items():
                    self._folders[*path, name] = self._gui.add_folder(None, visible=name == kind)
                    with self._folders[*path, name]:
                        self.add(value if name == kind else alternative(), (*path, name))
                return
        kind = _kind(field)
        if typing.get_origin(kind.annotation) is Literal and len(typing.get_args(kind.annotation)) > 1:
            handle = self._gui.add_dropdown(label, typing.get_args(kind.annotation), initial_value=value, hint=hint)
        elif path == ("world",):
            worlds = tuple(dict.fromkeys([value, *WORLDS]))
            handle = self._gui.add_dropdown(label, worlds, initial_value=value, hint=hint)
        elif isinstance(value, bool):
            handle = self._gui.add_checkbox(label, value, hint=hint)
        elif path in self.designed:
            return self._add_designed(value, field, path)
        elif isinstance(value, int | float) and (limits := _limits(kind, _scale(path, value))):
            low, high, step = limits
            self._limits[path] = low, high
            # Whole numbers are floats too: viser accepts an int of any size from a page, and then fails to pack it for
            # the other pages.
            if kind is field and path != SEED_FIELDS and (ends := slider_range(path, field, (low, high), self._robot)):
                self._sliders[path] = field, ends
                first, last = min(ends[0], value), max(ends[1], value)
                step = step if kind.annotation is int else _step(last - first, value)
                handle = self._gui.add_slider(label, first, last, step, float(value), hint=hint)
            else:
                handle = self._gui.add_number(label, float(value), min=low, max=high, step=step, hint=hint)
        else:
            return
        self._listen(path, handle, whole=kind.annotation is int)

    def _add_designed(self, value: float | None, field: FieldInfo, path: tuple[str, ...]) -> None:
        """Adds the input of a number that follows from the design while it is not set, and the button to the design."""
        value = float(value or 0)
        limits = _limits(_kind(field), value / 10)  # three digits
        assert limits is not None
        low, high, step = limits
        self._labels[path] = label = self._label(path, field)
        handle = self._gui.add_number(
            label, value, min=min(low, value), max=max(high, value), step=step, hint=self._hint(path, field)
        )
        self._limits[path] = low, high
        self._buttons[path] = button = self._gui.add_button(f"{_words(path)} as designed", visible=False, color="gray")
        self._listen(path, handle)

        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._on_change(path, None)

    def _label(self, path: tuple[str, ...], field: FieldInfo | None = None) -> str:
        """Returns the name of a field in words and its unit, with a mark if its change begins another run."""
        unit = UNIT.search(ASIDE.split(field.description or "")[0]) if field else None
        label = f"{_words(path)}, {unit[1]}" if unit else _words(path)
        return label if path[0] in self._changeable else label + NEW_RUN_MARK

    def _hint(self, path: tuple[str, ...], field: FieldInfo) -> str:
        """Returns the text that a page shows when the mouse is over an input: its description and its limits.

        A page moves a number beyond them to the nearest one.
        """
        known = with_limits(field.description or "", _kind(field))
        return known if path[0] in self._changeable else f"{known} {NEW_RUN_HINT}".lstrip()

    def _listen(self, path: tuple[str, ...], handle: Any, whole: bool = False) -> None:  # noqa: ANN401
        """Reports the values of an input, rounded if the field is a whole number."""
        self._inputs[path] = handle
        # The path of a field is without the kind.
        field = tuple(name for i, name in enumerate(path) if path[: i + 1] not in self._folders)

        @handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                value = handle.value
                if isinstance(value, float):
                    low, high = self._limits[path]
                    if value < low:
                        return  # somebody types: 0.05 begins with 0, and a page raises what is left below the limit
                    if path in self._sliders and value <= high:  # before the page limits it to the ends of the slider
                        handle.min, handle.max = min(handle.min, value), max(handle.max, value)
                self._on_change(field, round(value) if whole and isfinite(value) else value)

    def hide(self, names: Iterable[str]) -> None:
        """Hides the inputs of the fields of these names, and shows those of others that it hid before."""
        before, self._hidden = self._hidden, set(names)
        for name in before ^ self._hidden:
            _update(self._records.get(name) or self._inputs[name,], visible=name not in self._hidden)

    def show(self, record: Record, path: tuple[str, ...] = ()) -> None:
        """Sets the inputs of a record, whose path is given, to its values."""
        for name, field in type(record).model_fields.items():
            where = (*path, name)
            value = self._shown(record, where)
            if isinstance(value, Record):
                if where in self._inputs:
                    kind = type(value).model_fields["kind"].default
                    self._set(where, kind)
                    for other in _kinds(field):
                        _update(self._folders[*where, other], visible=other == kind)
                    where = (*where, kind)
                self.show(value, where)
            elif where in self._inputs:
                if where in self._buttons:
                    self._show_design(where, value, getattr(record, name) is not None)
                if value is not None:
                    self._set(where, value)

    def _show_design(self, path: tuple[str, ...], value: float | None, own: bool) -> None:
        """Says whether a field has a value of its own or that of the design, which may be beyond what may be set."""
        handle, label = self._inputs[path], self._labels[path]
        _update(self._buttons[path], visible=own)
        _update(handle, label=label if own else f"{label} (designed)", visible=value is not None)
        if value is not None:  # a page would move a value that is beyond the limits of its input
            _update(handle, min=min(handle.min, value), max=max(handle.max, value))

    def _set(self, path: tuple[str, ...], value: Any) -> None:  # noqa: ANN401
        handle = self._inputs[path]
        if path in self._sliders:
            low, high = self._sliders[path][1]
            if low <= value <= high:
                _update(handle, min=low, max=high)
            else:  # an end that was moved stays, for a hand may come back
                _update(handle, min=min(handle.min, value), max=max(handle.max, value))
        _update(handle, value=value)

    def suit(self, robot: Robot) -> None:
        """Gives the sliders the ranges that suit a robot."""
        if robot == self._robot:
            return
        self._robot = robot
        for path, (field, ends) in self._sliders.items():
            self._sliders[path] = field, slider_range(path, field, self._limits[path], robot) or ends
            self._fit(path, self._inputs[path].value)

    def _fit(self, path: tuple[str, ...], value: float) -> None:
        """Gives a slider its own range, or moves one end to a value beyond it."""
        low, high = self._sliders[path][1]
        _update(self._inputs[path], min=min(low, value), max=max(high, value))

    def _shown(self, record: Record, path: tuple[str, ...]) -> Any:  # noqa: ANN401
        """Returns the value of a field; one that is not set has the value of the tier or of the design."""
        name = path[-1]
        if (own := getattr(record, name)) is not None:
            return own
        if isinstance(record, Sensing):
            return record.source if name == "estimator" else record[name]
        return self.designed.get(path)


def _update(handle: Any, **properties: Any) -> None:  # noqa: ANN401
    """Sets those properties of a handle that differ; viser takes 20 µs for one, and an event shows some two hundred."""
    for name, value in properties.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def _words(path: tuple[str, ...]) -> str:
    """Returns the name of a field in words."""
    return path[-1].replace("_", " ")


def _kind(field: FieldInfo) -> FieldInfo:
    """Returns the field; for one that may be None, a field of its other type, with the limits of that type."""
    kinds = typing.get_args(field.annotation)
    return FieldInfo.from_annotation(kinds[0]) if len(kinds) == 2 and type(None) in kinds else field


def _scale(path: tuple[str, ...], value: float) -> float:
    """Returns the number on which the step of an input depends: its present value, or the least one of any tier."""
    if path[0] != "sensing":
        return value
    name = START.get(path[-1], path[-1])
    return min((v for v in TIER_VALUES[name] if v > 0), default=1.0)


def _kinds(field: FieldInfo) -> dict[str, type[Record]]:
    """Returns the alternatives of a record that comes in several kinds, by kind; empty for other fields."""
    return {k.model_fields["kind"].default: k for k in typing.get_args(field.annotation) if field.discriminator}


def _limits(field: FieldInfo, value: float) -> tuple[float, float, float] | None:
    """Returns lower limit, upper limit and a suitable step of an input, or None for a field without both limits."""
    limits = bounds(field)
    low, high = limits.get(Ge, limits.get(Gt)), limits.get(Le, limits.get(Lt))
    if low is None or high is None:
        return None
    if field.annotation is int:
        return float(low + (Gt in limits)), float(high - (Lt in limits)), 1.0
    step = _step(high - low, value)
    return float(low + step * (Gt in limits)), float(high - step * (Lt in limits)), step


def _step(width: float, value: float) -> float:
    """Returns a power of ten that is a suitable step of a number, of an interval and of a value in it."""
    return 10.0 ** floor(log10(min(width / 1000, abs(value) / 10 or width)))
