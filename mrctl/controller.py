"""A feedforward of your own, named by its file: `my_file.py:MyController`.

The name stands for a factory as `simulate` takes it: called with the nominal robot and the number of robots, it returns
an object with the two methods of `mrctl.control.feedforward.Feedforward`. Loading runs the file.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from functools import lru_cache
from pathlib import Path

from mrctl.record import InputError
from mrctl.scenario import Scenario
from mrctl.simulate import Factory, Simulation


def split(name: str) -> tuple[Path, str]:
    """File and what in it.

    Raises:
        InputError: It is not `FILE.py:NAME`, or there is no such file.
    """
    file, _, attribute = name.rpartition(":")
    if not file.endswith(".py") or not attribute.isidentifier():
        raise InputError(f"controller: {name!r} is not of the form my_file.py:MyController")
    if not Path(file).is_file():
        raise InputError(f"controller: no file {file}")
    return Path(file).absolute(), attribute


def digest(name: str) -> str:
    """Tells whether two files are the same.

    Raises:
        InputError: As `split`.
    """
    return hashlib.sha256(split(name)[0].read_bytes()).hexdigest()


@lru_cache
def load(name: str) -> Factory:
    """Runs the file and returns the factory.

    Raises:
        InputError: As `split`; the file fails; it has no such name, or one that cannot be called.
    """
    path, attribute = split(name)
    module_name = f"mrctl_controller_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec and spec.loader
    module = sys.modules[module_name] = importlib.util.module_from_spec(spec)  # dataclasses look there
    sys.path.insert(0, str(path.parent))  # as for a script: what lies beside it can be imported
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise _refused(name, error) from None
    finally:
        sys.path.remove(str(path.parent))
    if not callable(getattr(module, attribute, None)):
        raise InputError(f"controller: {path.name} has no {attribute} that can be called with a robot and a size")
    return getattr(module, attribute)


def trial(name: str, scenario: Scenario) -> None:
    """Tries the factory and its stage on two robots for a few ticks, before much is computed.

    Raises:
        InputError: As `load`; the scenario is bad; or whatever went wrong in the controller.
    """
    factory = load(name)
    Simulation([scenario])  # what is wrong with the scenario is no fault of the controller
    try:
        simulation = Simulation([scenario, scenario], factory)
        for _ in range(min(3, simulation.ticks)):
            simulation.step()
    except Exception as error:  # noqa: BLE001 (it is somebody else's code)
        raise _refused(name, error) from None


def _refused(name: str, error: BaseException) -> InputError:
    return InputError(" ".join(f"controller: {name}: {type(error).__name__}: {error}".split()))
