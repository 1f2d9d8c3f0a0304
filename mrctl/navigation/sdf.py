"""Worlds of Gazebo in SDF, such as those of the BARN challenge, from the user's own copy.

BARN: Perille, Truong, Xiao and Stone, "Benchmarking metric ground navigation", IEEE SSRR 2020.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mrctl.kernel import Array
from mrctl.record import InputError, read_file
from mrctl.theory.obstacles import GROUND_HEIGHT, OVERHEAD_HEIGHT, Obstacles, turned


def read_sdf(path: str | Path) -> Obstacles:
    """Reads the cylinders, boxes and spheres that the models of an SDF world collide with.

    Models that the world includes from other files, such as ground and sun, are left out, and so is what ends at 2 cm
    or lower or begins at 1 m or higher. A pose in the world's `<state>` is used in place of that of the model, but not
    of models in it.

    Args:
        path: The `.world` or `.sdf` file.

    Raises:
        InputError: The file is no SDF world, a pose or a model is placed by a frame that it names, the state scales a
            model, the places of models are random, or one of the shapes is a mesh or not upright.
    """
    text = read_file(path)
    try:
        world = ElementTree.fromstring(text).find("world")
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two: an encoding that is not read
        raise InputError(f"{path}: no SDF file, as it is not XML: {error}") from None
    if world is None:
        raise InputError(f"{path}: no SDF file with a <world>")
    shapes = []
    try:
        placed = {
            model.get("name"): _pose(model) for model in world.iterfind("state/model") if model.find("pose") is not None
        }
        if world.find("population") is not None:
            raise InputError("has a <population>, whose models Gazebo places at random")
        for model in world.iterfind("state/model"):
            if (scale := model.findtext("scale")) and _finite(scale.split()) != [1.0, 1.0, 1.0]:
                raise InputError(f"model {model.get('name')}: its state scales it by {scale}, which is not read")
        for model in world.iterfind("model"):
            name = model.get("name")
            shapes += _shapes(model, placed[name] if name in placed else _pose(model))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return Obstacles.from_dict({"shapes": shapes}, str(path))


def _shapes(model: ElementTree.Element, base: Array) -> list[dict]:
    """Returns the obstacles of a model at its pose `(6,)`, and of the models in it."""
    found, name = [], f"model {model.get('name')}"
    if frame := model.get("placement_frame"):
        raise InputError(f"{name}: is placed by its frame {frame}, and such models are not read")
    for link in model.iterfind("link"):
        for collision in link.iterfind("collision"):
            found += _shape(collision, _after(_after(base, _pose(link)), _pose(collision)), name)
    for inner in model.iterfind("model"):
        found += _shapes(inner, _after(base, _pose(inner)))
    return found


def _pose(element: ElementTree.Element) -> Array:
    """Returns x, y, z, roll, pitch and yaw of an element in m and rad, `(6,)`; zeros where it has no pose.

    Raises:
        InputError: The pose is not six numbers, or counts from another frame than that of the element around it.
    """
    pose, name = element.find("pose"), element.get("name")
    text = ((pose is not None and pose.text) or "0 0 0 0 0 0").split()
    if pose is not None and (frame := pose.get("relative_to")):
        raise InputError(f"{name}: pose: is relative to {frame}, and such poses are not read")
    try:
        found = np.array(_finite(text)).reshape(6)
    except ValueError:
        raise InputError(f"{name}: pose: {' '.join(text)!r} is not six numbers") from None
    if pose is not None and pose.get("degrees") in ("true", "1"):
        found[3:] = np.deg2rad(found[3:])
    return found


def _after(base: Array, pose: Array) -> Array:
    """Returns a pose that counts from another one; tilts add up, which is right where there is none."""
    found = base + pose
    found[:2] = turned(pose[None, :2], base[[0, 1, 5]])[0]
    return found


def _finite(words: list[str]) -> list[float]:
    """Returns words as numbers.

    Raises:
        ValueError: One is no finite number.
    """
    found = [float(word) for word in words]
    if not np.isfinite(found).all():
        raise ValueError
    return found


def _numbers(shape: ElementTree.Element, field: str, count: int, name: str) -> list[float]:
    """Returns the numbers in a field of a shape; `name` is that of the model.

    Raises:
        InputError: There is no such field, or it has not as many numbers.
    """
    try:
        found = _finite((shape.findtext(field) or "").split())
    except ValueError:
        found = []
    if len(found) != count:
        raise InputError(f"{name}: {shape.tag} has no valid {field}")
    return found


def _shape(collision: ElementTree.Element, pose: Array, name: str) -> list[dict]:
    """Returns the obstacle of a collision element at its pose `(6,)`, or nothing for ground and what hangs overhead.

    Raises:
        InputError: The shape is not one that is read, or not upright.
    """
    geometry = collision.find("geometry")
    shape = geometry[0] if geometry is not None and len(geometry) else collision
    if shape.tag in ("plane", "empty"):
        return []
    if shape.tag not in ("cylinder", "box", "sphere"):
        raise InputError(f"{name}: its shape is a {shape.tag}, not a cylinder, box or sphere")
    size = _numbers(shape, "size", 3, name) if shape.tag == "box" else _numbers(shape, "radius", 1, name)
    if shape.tag == "cylinder":
        (height,) = _numbers(shape, "length", 1, name)
    else:
        height = size[2] if shape.tag == "box" else 2 * size[0]
    half = height / 2
    if pose[2] + half <= GROUND_HEIGHT:
        return []
    if shape.tag != "sphere" and np.abs(pose[3:5]).max() > 1e-3:
        raise InputError(f"{name}: is not upright")
    if pose[2] - half >= OVERHEAD_HEIGHT:
        return []
    x, y, yaw = (float(value) for value in pose[[0, 1, 5]])
    if shape.tag == "box":
        yaw = float(np.arctan2(np.sin(yaw), np.cos(yaw)))
        return [{"kind": "box", "x": x, "y": y, "angle": yaw, "length": size[0], "width": size[1]}]
    return [{"kind": "disc", "x": x, "y": y, "radius": size[0]}]
