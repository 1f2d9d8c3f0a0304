"""Tracking and navigation as `dm_env` environments, built on `dm_control.rl.control` like a domain of its suite.

`SUITE["residual"]()` makes an environment; after `register()`, so does `dm_control.suite.load("mrctl", "residual")`.
"""

# pyright: reportIncompatibleMethodOverride=false
# (the methods of dm_control's Task have no return types, and pyright infers None)

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
from dm_control.mujoco.engine import Physics
from dm_control.rl import control
from dm_control.utils import containers
from dm_env import specs

from mrctl.envs.episodes import ACTION_KINDS, Action, Draw, Episodes, read
from mrctl.envs.navigation import Navigating, read_mission
from mrctl.kernel import Array
from mrctl.physics.plant import PhysicsPlant
from mrctl.scenario import Scenario

SUITE = containers.TaggedTasks()


class Tracking(control.Task):
    """A task in which one robot follows the reference of a scenario.

    The first episode has the seed of the scenario; each later one draws a seed.

    Attributes:
        episodes: The closed loop.
    """

    def __init__(
        self,
        scenario: Scenario,
        action: Action,
        random: int | np.random.RandomState | None = None,
        draw: Draw | None = None,
    ) -> None:
        """Stands the robot on its reference.

        Args:
            scenario: The scenario.
            action: Meaning of an action, as for `mrctl.envs.episodes.Episodes`.
            random: Seed or generator from which the seeds of the later episodes are drawn; by default the scenario's
                seed.
            draw: Draws the perturbation of every episode from a `numpy.random.Generator`, which the episode's seed
                determines; by default every episode has that of the scenario.

        Raises:
            InputError: The scenario is invalid.
        """
        self._set_up(Episodes([scenario], action, draw=draw), random)

    def _set_up(self, episodes: Episodes, random: int | np.random.RandomState | None) -> None:
        """Takes the closed loop and the source of seeds."""
        self.episodes, scenario = episodes, episodes.scenarios[0]
        seed = scenario.seed if random is None else random
        self._random = seed if isinstance(seed, np.random.RandomState) else np.random.RandomState(seed)
        self._next = scenario.seed
        self.visualize_reward = False

    def initialize_episode(self, physics: Physics) -> None:
        """Begins an episode with the next seed."""
        self.episodes.begin_all([self._next])
        self._next = int(self._random.randint(2**32, dtype=np.uint32))

    def before_step(self, action: Array, physics: Physics) -> None:
        """Applies the events, measures, sends the commands and moves obstacles; the action has shape `(2,)`."""
        self.episodes.act(action)
        self.episodes.send()
        self.episodes.plant.move_obstacles(1)

    def after_step(self, physics: Physics) -> None:
        """Finds collisions, reads the state after the physics steps, records it, and finds other failures."""
        self.episodes.plant.collide()
        self.episodes.plant.look()
        self.episodes.settle()

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Returns the bounds of an action, `(2,)`, in the units of `mrctl.envs.episodes.Episodes`."""
        bound = self.episodes.bound
        return specs.BoundedArray((2,), float, -bound, bound, name="action")

    def get_observation(self, physics: Physics) -> dict[str, Array]:
        """Returns the parts of an observation by name, with the sizes in `episodes.sizes`."""
        seen, sizes = self.episodes.observe()[0][0], self.episodes.sizes
        return dict(zip(sizes, np.split(seen, np.cumsum(list(sizes.values()))[:-1]), strict=True))

    def get_reward(self, physics: Physics) -> float:
        """Returns the reward of the last control period; see `observe` of the episodes."""
        return float(self.episodes.observe()[1][0])

    def get_termination(self, physics: Physics) -> float | None:
        """Returns discount 0 where the robot has failed or arrived, 1 at the end of the scenario, and None before."""
        (terminated,), (truncated,) = self.episodes.ended()
        return 0.0 if terminated else 1.0 if truncated else None


class Navigation(Tracking):
    """A task in which one robot with a lidar gets a goal; its seeds are those of `Tracking`."""

    def __init__(
        self, scenario: Scenario, random: int | np.random.RandomState | None = None, draw: Draw | None = None
    ) -> None:
        """Stands the robot at its start.

        Args:
            scenario: The scenario, with a goal.
            random: As for `Tracking`.
            draw: As for `Tracking`.

        Raises:
            InputError: The scenario is invalid.
        """
        self._set_up(Navigating([scenario], draw=draw), random)


class Environment(control.Environment):
    """The environment of `dm_control` for a `Tracking` task; the task places the robot and detects failures."""

    def __init__(self, task: Tracking, **settings: Any) -> None:  # noqa: ANN401
        """Builds the environment of a task.

        Args:
            task: The task.
            settings: Further arguments of `dm_control.rl.control.Environment`, such as `flat_observation`.
        """
        plant = task.episodes.plant
        assert isinstance(plant, PhysicsPlant)
        super().__init__(plant.physics, task, n_sub_steps=plant.substeps, legacy_step=False, **settings)

    def reset(self) -> dm_env.TimeStep:
        """Begins an episode.

        It replaces the method of the base class, which would leave forces of the last episode in the solver.
        """
        self._reset_next_step = False
        self._step_count = 0
        self._task.initialize_episode(self._physics)
        observation = self._task.get_observation(self._physics)
        return dm_env.restart(control.flatten_observation(observation) if self._flat_observation else observation)

    def step(self, action: Array) -> dm_env.TimeStep:
        """Runs one control period; a state that diverges ends the episode instead of raising an error."""
        with self._physics.suppress_physics_errors():
            return super().step(action)


def _add(name: str, tag: str, make: Callable[..., Tracking], description: str) -> None:
    """Adds a task to the suite; `make` takes a scenario, its file or None, a source of seeds, and a `Draw` or None."""

    def task(
        scenario: Scenario | str | Path | None = None,
        random: int | np.random.RandomState | None = None,
        environment_kwargs: dict[str, Any] | None = None,
        draw: Draw | None = None,
    ) -> Environment:
        return Environment(make(scenario, random, draw), **(environment_kwargs or {}))

    task.__name__, task.__doc__ = name, f"Makes an environment in which {description}."
    SUITE.add(tag)(task)


for _action in ACTION_KINDS:
    _make = partial(lambda action, scenario, random, draw: Tracking(read(scenario), action, random, draw), _action)
    _add(_action, "tracking", _make, f"an action is a {_action}; the scenario is one lap by default")
_add(
    "navigation", "navigation", lambda scenario, random, draw: Navigation(read_mission(scenario), random, draw),
    "a robot is told a goal; the scenario is a mission through a door by default",
)  # fmt: skip


def register() -> None:
    """Registers the tasks as the domain `mrctl` of `dm_control.suite`, whose import takes seconds."""
    from dm_control import suite

    suite._DOMAINS["mrctl"] = sys.modules[__name__]  # as the suite does with its own domains
