"""Tracking as `dm_env` tasks, through `dm_control.rl.control.Environment`, in the manner of a suite domain.

`SUITE["residual"]()` makes an environment; after `register()`, so does `dm_control.suite.load("mrctl", "residual")`.
"""

# pyright: reportIncompatibleMethodOverride=false
# (the methods of dm_control's Task have no return types, which pyright takes for None)

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
from dm_control.mujoco.engine import Physics
from dm_control.rl import control
from dm_control.utils import containers
from dm_env import specs

from mrctl.envs.episodes import ACTION_KINDS, OBSERVATIONS, Action, Array, Episodes, read
from mrctl.physics.plant import PhysicsPlant
from mrctl.scenario import Scenario

SUITE = containers.TaggedTasks()


class Tracking(control.Task):
    """Follow the reference of a scenario. The first episode has the scenario's seed, the others draw theirs.

    Attributes:
        episodes: The closed loop.
    """

    def __init__(self, scenario: Scenario, action: Action, random: int | np.random.RandomState | None = None) -> None:
        """Stands the robot on its reference.

        Args:
            scenario: Whose physics, reference, controllers and events.
            action: As for `Episodes`.
            random: For the seeds of the later episodes; by default seeded by the scenario.
        """
        self.episodes = Episodes([scenario], action)
        seed = scenario.seed if random is None else random
        self._random = seed if isinstance(seed, np.random.RandomState) else np.random.RandomState(seed)
        self._next = scenario.seed
        self.visualize_reward = False

    def initialize_episode(self, physics: Physics) -> None:
        """Begins again with the next seed."""
        self.episodes.begin_all([self._next])
        self._next = int(self._random.randint(2**32, dtype=np.uint32))

    def before_step(self, action: Array, physics: Physics) -> None:
        """Events, measurement, control."""
        self.episodes.act(np.asarray(action, float)[None])
        self.episodes.plant.send(self.episodes.decide())

    def after_step(self, physics: Physics) -> None:
        """Readouts, record, failures."""
        self.episodes.plant.look()
        self.episodes.settle()

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Two numbers; see `Episodes`."""
        bound = self.episodes.bound
        return specs.BoundedArray((2,), float, -bound, bound, name="action")

    def get_observation(self, physics: Physics) -> dict[str, Array]:
        """As named in `mrctl.envs.episodes.OBSERVATIONS`."""
        seen = self.episodes.observe()[0][0]
        ends = np.cumsum(list(OBSERVATIONS.values()))
        return dict(zip(OBSERVATIONS, np.split(seen, ends[:-1]), strict=True))

    def get_reward(self, physics: Physics) -> float:
        """See `Episodes.observe`."""
        return float(self.episodes.observe()[1][0])

    def get_termination(self, physics: Physics) -> float | None:
        """Discount 0 where the robot has failed, 1 at the end of the scenario, None before."""
        return 0.0 if self.episodes.plant.failed[0] else 1.0 if self.episodes.over()[0] else None


class Environment(control.Environment):
    """`dm_control`'s environment for a robot that stands up by itself, and whose task judges its state."""

    def __init__(self, task: Tracking, **settings: Any) -> None:  # noqa: ANN401
        """Takes a task, and what `dm_control.rl.control.Environment` takes beside physics and rates."""
        plant = task.episodes.plant
        assert isinstance(plant, PhysicsPlant)
        super().__init__(plant.physics, task, n_sub_steps=plant.substeps, legacy_step=False, **settings)

    def reset(self) -> dm_env.TimeStep:
        """Begins an episode. The context that the base class resets in would leave forces in the solver's memory."""
        self._reset_next_step = False
        self._step_count = 0
        self._task.initialize_episode(self._physics)
        observation = self._task.get_observation(self._physics)
        return dm_env.restart(control.flatten_observation(observation) if self._flat_observation else observation)

    def step(self, action: Array) -> dm_env.TimeStep:
        """One control period."""
        with self._physics.suppress_physics_errors():
            return super().step(action)


def _add(action: Action) -> None:
    def task(
        scenario: Scenario | str | Path | None = None,
        random: int | np.random.RandomState | None = None,
        environment_kwargs: dict[str, Any] | None = None,
    ) -> Environment:
        return Environment(Tracking(read(scenario), action, random), **(environment_kwargs or {}))

    task.__name__ = action
    task.__doc__ = f"Tracking where the action is the {action}; one lap by default."
    SUITE.add("tracking")(task)


for _action in ACTION_KINDS:
    _add(_action)


def register() -> None:
    """Makes the tasks known to `dm_control.suite` as the domain `mrctl`; importing that takes seconds."""
    from dm_control import suite

    suite._DOMAINS["mrctl"] = sys.modules[__name__]  # which is how its own domains are found
