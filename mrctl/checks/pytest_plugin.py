"""The pytest plugin: `pytest --mrctl-robot ROBOT.xml` runs each physics check of `mrctl check` as a test.

pytest loads this file in every project of an environment that has mrctl, so NumPy, MuJoCo and Numba are imported only
once the option is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from mrctl.checks.catalogue import Check
    from mrctl.checks.examination import Examination


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the option `--mrctl-robot`."""
    text = (
        "run mrctl's physics checks on this robot (MJCF), and no other tests unless files or folders are given as well"
    )
    parser.getgroup("mrctl").addoption("--mrctl-robot", metavar="ROBOT.xml", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Adds the robot's file to the paths on the command line; without any, pytest collects that file alone."""
    if robot := _robot(config):
        if config.args_source is not pytest.Config.ArgsSource.ARGS:
            config.args = []
        if str(robot) not in config.args:
            config.args.append(str(robot))


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collects the robot's file, and no other."""
    return RobotTests.from_parent(parent, path=file_path) if file_path == _robot(parent.config) else None


def _robot(config: pytest.Config) -> Path | None:
    """Returns the robot's file, if the option is given."""
    name = config.getoption("mrctl_robot")
    return (config.invocation_params.dir / name).resolve() if name else None


class RobotTests(pytest.File):
    """A robot's file, as a collection of tests."""

    def collect(self) -> Iterator[PhysicsCheck]:
        """Yields a test for each check.

        Raises:
            CollectError: The robot cannot be loaded.
        """
        from mrctl.checks.command import examination
        from mrctl.record import InputError

        try:
            robot = examination(str(self.path))
        except InputError as error:
            raise self.CollectError(str(error)) from None
        for check in robot.checks:
            yield PhysicsCheck.from_parent(self, name=check.name, check=check, examination=robot)


class PhysicsCheck(pytest.Item):
    """A check on the robot, as a test."""

    def __init__(self, check: Check, examination: Examination, **kwargs: object) -> None:
        """Takes the check and the robot's examination."""
        super().__init__(**kwargs)  # pyright: ignore[reportArgumentType]
        self._check, self._examination = check, examination

    def runtest(self) -> None:
        """Runs the check; one that does not suit the robot is skipped.

        Raises:
            _Failed: The check failed.
        """
        finding = self._examination.examine(self._check)
        if finding.reason:
            pytest.skip(finding.reason)
        if finding.status == "failed":
            from mrctl.checks.command import cause_line

            values = [str(c) for c in finding.report if not c.passed]
            causes = [f"{cause.cause}: {cause.text}" for cause in finding.causes]
            raise _Failed("\n".join([*values, cause_line(finding), *causes]))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException]) -> str:  # pyright: ignore
        """Returns measured values and causes, without a traceback."""
        return str(excinfo.value) if isinstance(excinfo.value, _Failed) else str(super().repr_failure(excinfo))

    def reportinfo(self) -> tuple[Path, None, str]:
        """Returns the file and the name of the check, for pytest's report."""
        return self.path, None, f"{self.path.name}: {self.name}"


class _Failed(AssertionError):
    """A check failed; the message holds its values and causes."""
