"""`pytest --mrctl-robot ROBOT.xml`: each physics check of `mrctl check` as a test.

Everything heavy is imported when the option is given: pytest loads this file in every project of the environment.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from mrctl.checks.catalogue import Check
    from mrctl.checks.diagnosis import Examination


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option."""
    text = "run mrctl's physics checks on this robot (MJCF); alone, unless files or folders are given as well"
    parser.getgroup("mrctl").addoption("--mrctl-robot", metavar="ROBOT.xml", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Makes the robot one of the files to collect from."""
    if robot := _robot(config):
        if config.args_source is not pytest.Config.ArgsSource.ARGS:
            config.args = []
        if str(robot) not in config.args:
            config.args.append(str(robot))


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Takes the robot's file."""
    return RobotFile.from_parent(parent, path=file_path) if file_path == _robot(parent.config) else None


def _robot(config: pytest.Config) -> Path | None:
    name = config.getoption("mrctl_robot")
    return (config.invocation_params.dir / name).resolve() if name else None


class RobotFile(pytest.File):
    """The file of a robot."""

    def collect(self) -> Iterator[PhysicsCheck]:
        """One test for each check."""
        from mrctl.checks.command import examination
        from mrctl.record import InputError

        try:
            patient = examination(str(self.path))
        except InputError as error:
            raise self.CollectError(str(error)) from None
        for check in patient.checks:
            yield PhysicsCheck.from_parent(self, name=check.name, check=check, patient=patient)


class PhysicsCheck(pytest.Item):
    """One check on the robot."""

    def __init__(self, check: Check, patient: Examination, **kwargs: object) -> None:
        """Takes the check and the robot's examination."""
        super().__init__(**kwargs)  # pyright: ignore[reportArgumentType]
        self._check, self._patient = check, patient

    def runtest(self) -> None:
        """Runs it; not applicable is skipped."""
        finding = self._patient.look(self._check)
        if finding.reason:
            pytest.skip(finding.reason)
        if finding.status == "failed":
            from mrctl.checks.command import because

            values = [str(c) for c in finding.report if not c.passed]
            causes = [f"{cause.cause}: {cause.text}" for cause in finding.causes]
            raise _Failed("\n".join([*values, *because(finding), *causes]))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException]) -> str:  # pyright: ignore
        """What was measured and why, without a traceback."""
        return str(excinfo.value) if isinstance(excinfo.value, _Failed) else str(super().repr_failure(excinfo))

    def reportinfo(self) -> tuple[Path, None, str]:
        """Where the report says that it failed."""
        return self.path, None, f"{self.path.name}: {self.name}"


class _Failed(AssertionError):
    """A check failed, with its explanation."""
