"""The command `mrctl navigate`: one mission, once more one that was saved, or the suite of missions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mrctl.cli.arguments import CONTROLLER_OF_VIEW, NOT_OF_MISSIONS, fields_set
from mrctl.cli.flags import EXPLAINED_FIELDS, is_short_help, partial_record
from mrctl.cli.shared import BEST, Incomplete, check_world, expect_same, show, warn_if_impossible
from mrctl.record import InputError, Record
from mrctl.scenario import FEEDFORWARDS, FeedforwardName, Scenario, controller_name

DEFAULTS = {
    "prior": "model, or none where --learner is given",
    "learner": "composite, or fel where --prior is given",
}


def navigate_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `navigate` command, whose short help leaves out the same fields as that of `run`."""
    names = EXPLAINED_FIELDS if is_short_help(arguments) else Scenario.model_fields
    default = Scenario() if {"prior", "learner"} & fields_set(arguments) else Scenario(**FEEDFORWARDS[BEST])
    part = partial_record(default, [name for name in names if name not in NOT_OF_MISSIONS], DEFAULTS)

    def navigate(
        world: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[WORLD|GENERATOR:SEED|MISSION]")] = "",
        /,
        scenario: Record = part,
        goal: tuple[float, float, float] | None = None,
        start: tuple[float, float, float] | None = None,
        known: Annotated[str | None, tyro.conf.arg(name="map")] = None,
        compare: Annotated[tuple[FeedforwardName, ...], tyro.conf.arg(metavar="NAME ...")] = (),
        speed: float | None = None,
        margin: float = 0.05,
        avoid: Literal["none", "barrier", "window", "mppi"] = "none",
        out: Path | None = None,
        json: bool = False,
        controller: tuple[str, ...] = (),
        view: bool = False,
        port: int = 8080,
        suite: bool = False,
        quick: bool = False,
        scheduler: str | None = None,
    ) -> None:
        """Plans a way among obstacles, drives it, and prints how the drive ended.

        The exit status is 1 if the first robot does not arrive. Its controller is that of --prior and --learner, with
        the defaults of `mrctl run` where one of them is given, and model+composite where none is. --robot NAME stands
        for --robot.path NAME, --sensing TIER for --sensing.tier TIER, and --localise NAME for --sensing.localisation
        NAME.

        Args:
            world: TOML file of obstacles, yaml file of a ROS map, world in SDF or MJCF, or a generator with a seed,
                such as doorway:3; the others are cellular, corridor, parking_bay, slalom and warehouse. Or the
                folder --out of a mission, which is then driven again and compared with what it holds, bit for bit.
            scenario: The scenario.
            goal: Drive to this pose, x and y in m and θ in rad, as in 2,0,0; by default to the generator's.
            start: Start at this pose, written as for --goal; by default at that of the generator, or the origin.
            known: Plan and localise on the map in this file, which may differ from the world and has one of the same
                formats; by default the map has all that stands still in the world.
            compare: Feedforwards of further robots, such as none or model, which drive the same plan.
            speed: Limit the plan to this speed in m/s; by default to 0.9 of the robot's largest. With --avoid the plan
                is never faster than lets the robot stop within the range of its lidar.
            margin: Keep this clearance in m in the plan.
            avoid: Law that keeps the robot from what its lidar sees beside the map, such as obstacles that move: none,
                a filter that brakes (`barrier`), or a controller that follows the plan at its own pace and drives
                around what is in the way (`window`, `mppi`).
            out: Write the result, the table in JSON and the figures to this folder.
            json: Print JSON instead of a table.
            controller: Controller of your own for the first robot, written as for mrctl suite, such as
                my_file.py:MyFeedforward or model+composite+feedback=my_file.py:MyFeedback; a motion controller takes
                the place of --avoid. With --suite, controllers of your own to compare with the others.
            view: Instead of a table, show the mission live in the browser, where clicks set further goals.
            port: Number of the port to listen on, with --view.
            suite: Instead of one mission, compare how narrow a corridor, and how fast, the robot can drive with PID,
                model, fel and model+composite, on three plants; then how narrow it may be with `window`, for a robot
                that sees the walls; then drive MPPI around obstacles, with and without a lag in its model, over PID and
                over model+composite; then plan with what model+composite has learned.
                Each part prints first how long it takes. The tables are written to --out, by default navigate_suite,
                where the same command goes on if it was stopped.
            quick: With --suite, drive fewer draws; some confidence intervals then have no upper end.
            scheduler: With --suite, use the workers of the Dask scheduler at this address, such as
                tcp://127.0.0.1:8786, instead of this machine's cores.
        """
        chosen = Scenario().replace(**{name: getattr(scenario, name) for name in type(scenario).model_fields})
        if port != 8080 and not view:
            raise InputError("port: belongs to --view")
        if suite:
            own = {"prior", "learner", "perturbation", "seed", "initial-spread", "goal", "start", "map", "compare"}
            if world or (own | {"speed", "margin", "avoid", "json", "view"}) & fields_set(arguments):
                raise InputError("suite: has its own worlds, controllers and speeds; give only flags of the robot")
            return _navigate_suite(chosen, controller, quick, out or Path("navigate_suite"), scheduler)
        if quick or scheduler is not None:
            raise InputError(f"{'quick' if quick else 'scheduler'}: belongs to --suite")
        if not world:
            taken = "; it stands before --controller, which takes every name after it" if controller else ""
            raise InputError(f"world: none given{taken}; see mrctl navigate --help")
        if Path(world).is_dir():
            return _repeat_mission(Path(world), arguments, out, json, controller)
        if view and (out is not None or json):
            raise InputError("view: a live session has no --out and --json")
        if view and controller:
            raise InputError(CONTROLLER_OF_VIEW.format("navigate"))
        if ":" not in world and not Path(world).is_file():
            raise InputError(f"world: no file {world}; mrctl navigate --help names the generators, such as doorway:3")
        check_world(chosen.world, chosen.robot)
        own = _own(controller)
        if own is not None:
            chosen = _fronted(own, chosen, bool({"prior", "learner"} & fields_set(arguments)))
        warn_if_impossible(chosen)
        from mrctl.navigation.mission import Order
        from mrctl.navigation.tasks import task_of

        task = task_of(world, chosen, start, goal, known)
        order = Order(task=task, scenario=chosen, compare=tuple(compare), speed=speed, margin=margin, avoid=avoid)
        if view:
            from mrctl.viewer import view as viewing

            return viewing.mission(order, "127.0.0.1", port)
        from mrctl.experiments import mission

        found = mission.run(world, order, out, json, own)
        show(found, out, json)
        _expect_arrival(found.ended)

    navigate.__annotations__["scenario"] = Annotated[type(part), tyro.conf.arg(name="")]
    return navigate


def _own(controller: Sequence[str]) -> str | None:
    """Returns a mission's controller of the user, or None."""
    if len(controller) > 1:
        raise InputError("controller: a mission has one of yours; --suite compares several")
    return controller[0] if controller else None


def _fronted(controller: str, scenario: Scenario, chosen: bool) -> Scenario:
    """Returns the scenario with the feedforward of mrctl in front of the user's controller.

    Args:
        controller: The user's controller.
        scenario: The scenario.
        chosen: Whether flags have chosen its prior or its learner.
    """
    from mrctl.loop import user_files

    front, own, parts = user_files.behind(controller)
    if chosen:
        has_own = any(part.stage == "feedforward" for part in parts)
        wanted = controller_name(scenario.prior, "none" if has_own else scenario.learner)
        form = own if wanted == "none" else f"{wanted}+{own}"
        raise InputError(f"controller: leave --prior and --learner out, and write {form}")
    return scenario.replace(**FEEDFORWARDS[front])


def _navigate_suite(
    scenario: Scenario, controllers: Sequence[str], quick: bool, out: Path, scheduler: str | None
) -> None:
    """Drives the suite of navigation: `mrctl navigate --suite`."""
    from mrctl.experiments import navigation_suite

    for tables in navigation_suite.suite(scenario, "quick" if quick else "core", out, scheduler, controllers):
        print(tables)


def _repeat_mission(
    folder: Path, arguments: Sequence[str], out: Path | None, json: bool, controller: Sequence[str]
) -> None:
    """Drives a saved mission again and compares it with what was saved: `mrctl navigate FOLDER`."""
    new = sorted({a.partition("=")[0] for a in arguments if a.startswith("--")} - {"--out", "--json", "--controller"})
    if new and (folder / "mission.json").exists():
        raise InputError(f"{new[0].removeprefix('--')}: {folder} holds a mission, which is driven as it was")
    from mrctl.experiments import mission

    found, departs = mission.repeat(folder, out, json, _own(controller))
    show(found, out, json)
    expect_same(folder, departs, json)
    _expect_arrival(found.ended)


def _expect_arrival(outcome: str) -> None:
    if outcome != "arrived":
        raise Incomplete(f"the robot did not arrive: {outcome}")
