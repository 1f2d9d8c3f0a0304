"""Finds MJCF files: the worlds and robots that come with mrctl by their names, and others by their paths."""

from __future__ import annotations

import hashlib
from importlib import resources
from pathlib import Path

from mrctl.physics.bounds import check_bounds
from mrctl.record import InputError, reading
from mrctl.theory.robot import RobotFile

SHIPPED = ("car", "turtlebot", "racecar")
"""Names of the shipped robots; the other shipped files are worlds, and `scenery`, which the worlds include."""


def models_folder() -> Path:
    """Returns the folder of the shipped MJCF files, in a checkout and in an installed wheel."""
    inside = Path(str(resources.files("mrctl"))) / "models"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "models"


def find(name: str) -> Path:
    """Returns the path of a shipped file by its name, or `name` itself where it ends in `.xml`; it need not exist."""
    return Path(name) if name.endswith(".xml") else models_folder() / f"{name}.xml"


def is_shipped(name: str) -> bool:
    """Tells whether a name stands for a file in the folder of the shipped ones; it need not exist."""
    return find(name).parent == models_folder()


def shipped_digest() -> str:
    """Returns a digest of the paths and contents of all shipped files, which include no others."""
    found = hashlib.sha256()
    for path in sorted(models_folder().glob("*.*")):
        with reading(path):
            found.update(bytes(path) + path.read_bytes())
    return found.hexdigest()


def _not_there(name: str, path: Path) -> str:
    """Returns what is wrong with a name that leads to no file."""
    return f"{name} is not an MJCF file, which ends in .xml" if name and Path(name).exists() else f"no file {path}"


def robot_path(robot: RobotFile) -> Path:
    """Returns the path of a robot's MJCF file.

    Raises:
        InputError: The file does not exist or is no robot; the message lists the shipped robots.
    """
    path = find(robot.path)
    if not path.is_file() or not (robot.path.endswith(".xml") or robot.path in SHIPPED):
        raise InputError(f"robot.path: {_not_there(robot.path, path)}; shipped robots: {', '.join(SHIPPED)}")
    check_bounds(path)
    return path


def world_path(world: str) -> Path:
    """Returns the path of a world's MJCF file.

    Args:
        world: The name of a shipped world, or a path that ends in `.xml`.

    Raises:
        InputError: The file does not exist or is a robot; the message lists the shipped worlds.
    """
    if world in SHIPPED:
        raise InputError(f"world: {world} is a robot; name it as robot.path")
    path = find(world)
    if not path.is_file():
        others = (*SHIPPED, "scenery")
        shipped = ", ".join(sorted(p.stem for p in models_folder().glob("*.xml") if p.stem not in others))
        raise InputError(f"world: {_not_there(world, path)}; shipped worlds: {shipped}")
    check_bounds(path)
    return path
