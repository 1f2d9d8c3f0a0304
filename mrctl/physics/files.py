"""The shipped MJCF files, and the paths that stand for them."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from mrctl.record import InputError
from mrctl.theory.robot import RobotFile

SHIPPED = ("car", "turtlebot", "racecar")  # robots among the models, which are no worlds



def models_folder() -> Path:
    """The folder of the shipped MJCF files, in a checkout and in an installed wheel."""
    inside = Path(str(resources.files("mrctl"))) / "models"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "models"



def find(name: str) -> Path:
    """The file of a shipped name, or the path itself if it ends in `.xml`."""
    return Path(name) if name.endswith(".xml") else models_folder() / f"{name}.xml"



def robot_path(robot: RobotFile) -> Path:
    """The file of a robot.

    Raises:
        InputError: There is none; the message lists the shipped robots.
    """
    path = find(robot.path)
    if not path.is_file() or not (robot.path.endswith(".xml") or robot.path in SHIPPED):
        raise InputError(f"robot.path: no file {path}; shipped robots: {', '.join(SHIPPED)}")
    return path



def world_path(world: str) -> Path:
    """The file of a world: one of the shipped names, or a path that ends in `.xml`.

    Raises:
        InputError: No such file; the message lists the shipped worlds.
    """
    if world in SHIPPED:
        raise InputError(f"world: {world} is a robot; name it as robot.path")
    path = find(world)
    if not path.is_file():
        others = (*SHIPPED, "scenery")
        shipped = ", ".join(sorted(p.stem for p in models_folder().glob("*.xml") if p.stem not in others))
        raise InputError(f"world: no file {path}; shipped worlds: {shipped}")
    return path
