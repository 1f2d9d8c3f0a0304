"""The command `mrctl run`: one scenario, or once more a run that was saved."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from mrctl.cli.arguments import check_switches, fields_set, scenario_file_of
from mrctl.cli.flags import explained, with_fields
from mrctl.cli.shared import Incomplete, check_exists, check_world, expect_same, show, suited, warn_if_impossible
from mrctl.record import InputError
from mrctl.scenario import Scenario


def run_with(arguments: list[str]) -> Callable[..., None]:
    """Returns the `run` command, whose flags take their defaults from the scenario file where one is given."""
    scenario_file = scenario_file_of(arguments) if arguments[0] == "run" else None
    default = Scenario.from_toml(scenario_file) if scenario_file else Scenario()

    def run(
        file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENARIO.toml|FOLDER]")] = None,
        /,
        scenario: Annotated[Scenario, tyro.conf.arg(name="")] = default,
        out: Path | None = None,
        json: bool = False,
        controller: str | None = None,
        number: Annotated[int | None, tyro.conf.arg(name="run")] = None,
        code: bool = True,
    ) -> None:
        """Runs one scenario and prints its metrics lap by lap. The exit status is 1 if the run fails.

        For example: mrctl run --learner rls --perturbation all --laps 2 reference:circle

        Args:
            file: A scenario file, whose values flags override; or the folder --out of a run, to repeat it and compare
                every bit (status 1 if one differs); or with --run a sweep's store.
            scenario: The scenario.
            out: Folder for the result, its figures and the learned weights.
            json: Print JSON instead of a table.
            controller: Stages of your own: my_file.py:MyFeedforward or motion=my_file.py:MyMotion,feedback=...
            number: Repeat the run of this number in a sweep's store, and compare it.
            code: With --run: whether a sweep's own Python files may be run.
        """
        if number is not None:
            return _repeat(file, number, arguments, out, json, code)
        if file is not None and file.is_dir():
            return _repeat_saved(file, arguments, out, json, controller)
        if file is not None and str(file) != scenario_file:
            check_switches(arguments)
            if file.suffix == ".xml":
                raise InputError(f"{file}: the file of a robot is given as --robot.path {file}")
            forms = "whose name ends in .toml, nor a reference, which is written as reference:circle"
            raise InputError(f"run: {file} is not a scenario file, {forms}; see mrctl run --help")
        check_world(scenario.world, scenario.robot)
        from mrctl.kernel import announced_early

        announced_early()
        from mrctl.experiments import single

        scenario = suited(scenario, arguments, scenario_file)
        _check_learner(scenario, controller, "learner" in fields_set(arguments))
        warn_if_impossible(scenario)
        found = single.run(scenario, out, json, controller)
        show(found, out, json)
        _expect_end(found.ended)

    return with_fields(run, default, explained(arguments))


def _check_learner(scenario: Scenario, controller: str | None, chosen: bool) -> None:
    """Refuses a learner that a flag has chosen beside a feedforward of the user, which is in its place."""
    if controller is None or not chosen or scenario.learner == "none":
        return
    from mrctl.loop import user_files

    for part in user_files.split(controller):
        if part.stage == "feedforward":
            raise InputError(f"learner: {part.title} is in the place of {scenario.learner}; leave --learner out")


def _repeat_saved(folder: Path, arguments: Sequence[str], out: Path | None, json: bool, controller: str | None) -> None:
    """Runs a saved run again and compares it with what was saved: `mrctl run FOLDER`."""
    if (folder / "mission.json").exists():
        raise InputError(f"run: {folder} holds a mission, which mrctl navigate {folder} repeats")
    if (folder / "sweep.json").exists():
        raise InputError(f"run: {folder} is the store of a sweep; for one of its runs give its number with --run")
    if new := sorted(fields_set(arguments) - {"out", "json", "controller"}):
        raise InputError(f"{new[0]}: {folder} holds a run, which is driven as it was; leave --{new[0]} out")
    from mrctl.kernel import announced_early

    announced_early()
    from mrctl.experiments import single

    found, departs = single.repeat(folder, out, json, controller)
    show(found, out, json)
    expect_same(folder, departs, json)
    _expect_end(found.ended)


def _expect_end(ended: str) -> None:
    """Fails the command if the run failed; the text says when and why."""
    if ended:
        raise Incomplete(f"the run failed {ended}")


def _repeat(
    store: Path | None, number: int, arguments: Sequence[str], out: Path | None, json: bool, code: bool
) -> None:
    """Runs one run of a sweep again and compares it with the store: `mrctl run STORE --run K`."""
    if store is None:
        raise InputError("run: --run needs the store of a sweep, as in mrctl run STORE --run 3")
    check_exists(store)
    if new := sorted(fields_set(arguments) - {"run", "out", "json", "code", "no-code"}):
        raise InputError(f"{new[0]}: {store} says how its runs are driven; leave --{new[0]} out")
    from mrctl.experiments import single
    from mrctl.sweep import jobs
    from mrctl.sweep.store import Store

    jobs.stages_of(store, number, code)
    jobs.check_files(store, number)
    driven = None
    if out is not None or json:
        sweep = jobs.sweep_of(Store(store))
        found = single.run(sweep.scenario(number), out, json, sweep.driven_by(number), sweep.hindsight)
        show(found, out, json)
        driven = found.result
    repeated = jobs.repeat(store, number, driven)
    verdict = f"run {number}: {repeated.verdict}"
    if not repeated.same:
        raise Incomplete(verdict)
    print(verdict, file=sys.stderr if json else sys.stdout)
