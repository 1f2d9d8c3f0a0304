"""The world, start and goal of a mission, from a file or from a generator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mrctl.navigation import generators
from mrctl.navigation.generators import Task
from mrctl.navigation.maps import read_map
from mrctl.navigation.sdf import read_sdf
from mrctl.navigation.vehicle import Vehicle
from mrctl.physics.obstacles import read_mjcf
from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.theory.obstacles import Obstacles, Pose

READERS: dict[str, Callable[[str], Obstacles]] = {
    ".toml": Obstacles.from_toml,
    ".yaml": lambda path: read_map(path).obstacles(),
    ".yml": lambda path: read_map(path).obstacles(),
    ".sdf": read_sdf,
    ".world": read_sdf,
    ".xml": read_mjcf,
}
# Openings are twice as wide as the robot; aisles, in which it also turns, are 2.5 times as wide as it is long. A bay,
# into which some robots go back and forth, is 2.5 times as long as the robot and 1.5 times as wide.
GENERATORS: dict[str, Callable[[float, float, int], Task]] = {
    "cellular": lambda length, width, seed: generators.cellular(seed),
    "corridor": lambda length, width, seed: generators.corridor(2 * width, seed),
    "slalom": lambda length, width, seed: generators.slalom(2 * width, seed),
    "doorway": lambda length, width, seed: generators.doorway(2 * width, seed),
    "warehouse": lambda length, width, seed: generators.warehouse(2.5 * length, seed),
    "parking_bay": lambda length, width, seed: generators.parking_bay(2.5 * length, 1.5 * width, seed),
}


def task_of(
    world: str,
    scenario: Scenario,
    start: Pose | None = None,
    goal: Pose | None = None,
    known: str | None = None,
) -> Task:
    """Reads or makes a world.

    Args:
        world: TOML file of obstacles, yaml file of a ROS map, world in SDF or MJCF, or a generator with its seed, as
            `doorway:3`.
        scenario: Scenario with the robot, whose size sets the openings of all generators but `cellular`.
        start: x and y in m and θ in rad; by default that of the generator, or the origin.
        goal: x and y in m and θ in rad; by default that of the generator.
        known: File of the obstacles on the robot's map, as for a world; by default those that stand still.

    Raises:
        InputError: The world or the map cannot be read, no generator has that name, or there is no goal.
    """
    chart = None if known is None else obstacles_of(known, "map")
    name, colon, seed = world.partition(":")
    if colon and name in GENERATORS:
        if not (seed.isdecimal() and len(seed) < 10):
            raise InputError(f"world: {world}: the seed must be a whole number from 0 to 999999999, as in {name}:3")
        vehicle = Vehicle.of(scenario)
        made = GENERATORS[name](vehicle.length, vehicle.width, int(seed))
        return made.replace(start=start or made.start, goal=goal or made.goal, map=chart)
    obstacles = obstacles_of(world, "world", f" nor a generator with a seed, such as {':3, '.join(GENERATORS)}:3")
    if goal is None:
        raise InputError("goal: a world from a file needs one: x and y in m, θ in rad")
    return Task.from_dict({"obstacles": obstacles, "start": start or (0.0, 0.0, 0.0), "goal": goal, "map": chart})


def obstacles_of(path: str, what: str, other: str = "") -> Obstacles:
    """Reads obstacles from a file of one of the `READERS`.

    Args:
        path: The file.
        what: Name of the argument, for messages.
        other: What else the argument may be, for the message.

    Raises:
        InputError: The file cannot be read, or its name has another ending.
    """
    if not (read := READERS.get(Path(path).suffix.lower())):
        neither = "neither" if other else "not"
        raise InputError(f"{what}: {path} is {neither} a file that ends in {', '.join(READERS)}{other}")
    if not Path(path).is_file():
        raise InputError(f"{what}: no file {path}")
    return read(path)
