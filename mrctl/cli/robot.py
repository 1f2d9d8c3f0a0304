"""The commands about a robot: `mrctl check`, `identify` and `tune`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from mrctl.cli.flags import LISTED_RECORDS, is_short_help
from mrctl.cli.shared import Incomplete, check_world, show
from mrctl.record import InputError, Record
from mrctl.sensing.tiers import LAB, TIERS, Sensing, Tier
from mrctl.theory.perturbation import PERTURBATIONS, Perturbation
from mrctl.theory.robot import CAR, RobotFile

DELAYS = 0.0, 0.01, 0.02  # s


def check(
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = "flat",
    /,
    wheels: tuple[str, ...] = (),
    steering: tuple[str, ...] = (),
    chassis: str = "",
    json: bool = False,
) -> None:
    """Runs the physics checks on a robot and names the likely cause of a failure in its model.

    That takes at most 30 s of processor time. The exit status is 1 if a check fails.

    Args:
        robot: The car, turtlebot or racecar, or the MJCF file of a robot, with or without a floor; by default the car.
        wheels: Joints of the two driven wheels, left and right; by default the two with a <dcmotor>.
        steering: Joints of the steered wheels, at most two; by default the upright joints with an actuator.
        chassis: Body that carries the wheels; by default the one at their root.
        json: Print JSON instead of a table.
    """
    from mrctl.physics.files import SHIPPED, find

    if not robot.endswith(".xml") and robot not in SHIPPED and not find(robot).is_file():
        raise InputError(f"robot: {robot} is neither {', '.join(SHIPPED)} nor an MJCF file, which ends in .xml")
    if robot.endswith(".xml") and not find(robot).is_file():
        raise InputError(f"robot: no file {robot}; there are {', '.join(SHIPPED)}")
    if robot in SHIPPED or wheels or steering or chassis:
        check_world("flat", RobotFile.from_dict({"path": robot}, "robot"))
    else:
        check_world(robot)
    from mrctl.checks import command as checking

    text, verdict = checking.run(robot, wheels, steering, chassis, json)
    print(text)
    if verdict:
        raise Incomplete(f"{robot}: {verdict}")


def identify_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `identify` command, whose short help leaves out the flags of its records."""

    def identify(
        file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = CAR.path,
        /,
        world: str = "flat",
        robot: RobotFile = CAR,
        perturbation: Perturbation = PERTURBATIONS["nominal"],
        sensing: Sensing = LAB,
        seed: int = 0,
        json: bool = False,
    ) -> None:
        """Identifies the constants of equation (3) from two drives, and says which of them the sensors identify.

        Args:
            file: The car, turtlebot or racecar, or the MJCF file of a robot; car stands for the robot of --world.
            world: The robot drives in this level world: `flat`, or the MJCF file at this path.
            robot: File of the robot, in place of ROBOT.xml, with the names of its joints and its chassis.
            perturbation: Differences of the plant from its model.
            sensing: Encoders, gyro and motor driver; delays, accelerometer, fixes and the estimator have no effect.
            seed: This seed determines the test signals and the noise of the sensors.
            json: Print JSON instead of a table.
        """
        if file != CAR.path:
            if robot != CAR:
                raise InputError("robot: give either a file or --robot FILE, beside which --robot.wheels may stand")
            robot = RobotFile.from_dict({"path": file}, "robot")
        check_world(world, robot)
        from mrctl.experiments import identify as identification

        print(identification.run(world, robot, perturbation, sensing, seed, json))

    if is_short_help(arguments):
        for name in LISTED_RECORDS:
            identify.__annotations__[name] = Annotated[Record, tyro.conf.Suppress]
    return identify


def tune(
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT.xml]")] = CAR.path,
    /,
    wheels: tuple[str, ...] = (),
    steering: tuple[str, ...] = (),
    chassis: str = "",
    world: str = "flat",
    delay: tuple[float, ...] = DELAYS,
    lag: float = 0.0,
    time_constant: float | None = None,
    search: str | None = None,
    tier: tuple[Tier, ...] = TIERS,
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Designs the velocity PID and the motion controller, measures the loops, and says where learning is safe.

    With --search, finds settings of a feedforward instead, by driving; the same command resumes after an interrupt.

    Args:
        robot: Robot to design for: `car`, `turtlebot`, `racecar`, or an MJCF file.
        wheels: Joints of the two driven wheels, left and right; by default the two with a <dcmotor>.
        steering: Joints of the steered wheels, at most two; by default the upright joints with an actuator.
        chassis: Body that carries the wheels; by default the one at their root.
        world: World to measure in: `flat`, `slope`, `rough`, `patch`, or the path of an MJCF file.
        delay: Delays of the loop in s in addition to sample and hold, each a multiple of the control period.
        lag: Time constant in s by which, as the design assumes, the measured velocities lag behind the true ones; not
            with --time-constant.
        time_constant: Time constant of the closed loop in s, for the IMC rule in place of the design.
        search: Feedforward whose settings to search, such as model+rls; none for the PID; or one of your own, such as
            my_file.py:MyController, whose class has an attribute such as search = {"gain": (0.01, 1.0)}.
        tier: With --search: sensing tiers to search in, each separately.
        out: Folder for the table, the measured responses and their figure; with --search for the table and the runs, by
            default a folder in search.
        json: Print JSON instead of a table.
    """
    if search is not None:
        given = robot, wheels, steering, chassis, world, delay, lag, time_constant
        if given != (CAR.path, (), (), "", "flat", DELAYS, 0.0, None):
            raise InputError(
                "search: drives the default car in worlds of its own; the flags of the design do not apply"
            )
        from mrctl.experiments.search import search as find

        print(find(search, tier, out, json))
        return
    if tier != TIERS:
        raise InputError("tier: belongs to --search; the design takes its delays from --delay")
    if time_constant is not None and lag:
        raise InputError("lag: has no effect with --time-constant, as the IMC rule knows no lag")
    check_world(world, RobotFile.from_dict({"path": robot}, "robot"))
    from mrctl.experiments import tuning
    from mrctl.physics.mjcf import load_robot

    file = (
        CAR
        if (robot, wheels, steering, chassis) == (CAR.path, (), (), "")
        else load_robot(robot, wheels, steering, chassis)
    )
    show(tuning.tune(file, world, time_constant, delay, lag, out, json), out, json)
