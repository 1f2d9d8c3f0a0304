"""Finds MJCF files: the worlds and robots that come with mrctl by their names, and others by their paths."""

from __future__ import annotations

import math
import re
import struct
from importlib import resources
from pathlib import Path

from mrctl.record import InputError, read_file
from mrctl.theory.grid import check_size
from mrctl.theory.robot import RobotFile

SHIPPED = ("car", "turtlebot", "racecar")
"""Names of the shipped robots; the other shipped files are worlds, and `scenery`, which the worlds include."""

MOST = 10_000  # elements that a file may ask for with a count; MuJoCo compiles them in some seconds
LARGEST = 64 * 2**20  # bytes of a mesh or an image
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
TAG = re.compile(r"<(/?)(\w+)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*)>")
ATTRIBUTE = re.compile(r"(\w+)\s*=\s*[\"']([^\"']*)[\"']")


def models_folder() -> Path:
    """Returns the folder of the shipped MJCF files, in a checkout and in an installed wheel."""
    inside = Path(str(resources.files("mrctl"))) / "models"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "models"


def find(name: str) -> Path:
    """Returns the path of a shipped file by its name, or `name` itself where it ends in `.xml`; it need not exist."""
    return Path(name) if name.endswith(".xml") else models_folder() / f"{name}.xml"


def robot_path(robot: RobotFile) -> Path:
    """Returns the path of a robot's MJCF file.

    Raises:
        InputError: The file does not exist or is no robot; the message lists the shipped robots.
    """
    path = find(robot.path)
    if not path.is_file() or not (robot.path.endswith(".xml") or robot.path in SHIPPED):
        raise InputError(f"robot.path: no file {path}; shipped robots: {', '.join(SHIPPED)}")
    bounded(path)
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
        raise InputError(f"world: no file {path}; shipped worlds: {shipped}")
    bounded(path)
    return path


def bounded(path: Path) -> None:
    """Refuses an MJCF file that would take MuJoCo minutes or gigabytes, before MuJoCo reads it.

    MuJoCo expands a `<replicate>` or `<composite>` of any count, makes height fields and textures of any size, and
    waits for ever on a pipe. The files that this one includes, and the meshes and images that it names, are checked as
    well.

    Raises:
        InputError: A count, a size or a file is beyond what a robot needs; the message names the element.
    """
    left, seen, made = [path], set(), 0
    while left:
        file = left.pop()
        seen.add(file)
        text = COMMENT.sub("", read_file(file, LARGEST).decode(errors="replace"))
        copies = [1.0]  # number of copies of what the open <replicate> elements contain, by depth
        folders = {path.parent}
        tags = [(closing, name, dict(ATTRIBUTE.findall(rest)), rest) for closing, name, rest in TAG.findall(text)]
        for _, name, values, _ in tags:
            if name == "compiler":
                folders |= {path.parent / values[a] for a in ("meshdir", "texturedir", "assetdir") if a in values}
        for closing, name, values, rest in tags:
            if name == "replicate":
                if closing:
                    copies = copies[:-1] or [1.0]
                elif not rest.endswith("/"):
                    copies.append(copies[-1] * _product(values.get("count", "1")))
            elif not closing:
                count = _product(values.get("count", "1")) if name in ("composite", "flexcomp") else 1.0
                made += copies[-1] * count if copies[-1] * count > 1 else 0
            if made > MOST or copies[-1] > MOST:
                raise InputError(f"{file}: <{name}> makes {max(made, copies[-1]):,.0f} elements; at most {MOST:,}")
            sizes = {"hfield": ("nrow", "ncol"), "texture": ("height", "width")}.get(name)
            if sizes and not closing:
                rows, columns = (int(_product(values.get(size, "0"))) for size in sizes)
                check_size(rows, columns, f"{file}: <{name}>")
            for folder in folders if not closing and "file" in values else ():
                named = folder / values["file"]
                if named not in seen and named.exists():
                    seen.add(named)
                    left += [named] if name == "include" else []
                    _check_asset(named)


def _product(text: str) -> float:
    """Returns the product of the numbers in an attribute; 1 where it holds no numbers, which MuJoCo then refuses."""
    try:
        return math.prod(min(max(float(number), 0.0), 1e9) for number in text.split())
    except ValueError:
        return 1.0


def _check_asset(file: Path) -> None:
    """Refuses a mesh or image that is not a regular file, is too large, or is a PNG of too many pixels."""
    head = read_file(file, LARGEST)[:24] if not file.is_dir() else b""
    if head.startswith(b"\x89PNG") and len(head) == 24:
        width, height = struct.unpack(">II", head[16:])
        check_size(height, width, str(file))
