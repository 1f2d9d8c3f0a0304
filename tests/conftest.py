"""Fixtures for every test."""

import pytest
from hypothesis import settings

from mrctl.theory.robot import Robot

# The same examples for everyone, no deadline (shared machines stall); `--hypothesis-profile=explore` looks further.
settings.register_profile("mrctl", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("mrctl")


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The default robot of the documentation, written out: tests of the laws need no MuJoCo."""
    return Robot(
        mass=20, yaw_inertia=0.6, com_offset=0.1, com_height=0.12,
        wheel_radius=0.098, front_wheel_radius=0.075, half_track=0.188,
        wheelbase=0.4, trail=0.03, steering_limit=1.0472,
        resistance=2.32, inductance=0, torque_constant=0.0234, gear_ratio=43, rotor_inertia=1.03e-6,
        no_load_current=0.037, gear_loss=0.1, rolling_coefficient=0.015, wheel_inertia=3.4e-3, front_wheel_inertia=1e-3,
        supply=24, tyre_friction=0.9, max_speed=1.5, max_rotation=3, max_acceleration=1.5, max_rotation_acceleration=6,
    )  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what runs the whole system, so that `pytest -m "not system"` is a quick loop for developers."""
    for item in items:
        if "system" in item.path.parts:
            item.add_marker("system")
