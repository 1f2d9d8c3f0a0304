"""Tracking as Gymnasium environments, for one robot or for many in a batch; needs `pip install 'mrctl[env]'`.

The import of this module registers `mrctl/TwistTracking-v0`, `mrctl/VoltageTracking-v0` and
`mrctl/ResidualTracking-v0`. An action is that of `mrctl.envs.episodes.Episodes` divided by its `bound`, so that it lies
between -1 and 1. An observation holds the quantities of `OBSERVATIONS` one after another. The seed of a reset is the
seed of the scenario: the episode has the same bits as `simulate` with that seed.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

try:
    import gymnasium
except ModuleNotFoundError:
    raise ModuleNotFoundError("mrctl.envs.gym needs Gymnasium: pip install 'mrctl[env]'", name="gymnasium") from None
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mrctl.envs.episodes import ACTION_KINDS, OBSERVATIONS, Action, Array, Episodes, read
from mrctl.scenario import Scenario

SEEDS = 2**32  # number of seeds that a scenario can have

OBSERVATION = Box(-np.inf, np.inf, (sum(OBSERVATIONS.values()),), np.float64)
ACTION = Box(-1.0, 1.0, (2,), np.float64)


class TrackingEnv(gymnasium.Env):
    """An environment in which one robot follows the reference of a scenario."""

    metadata = {"render_modes": []}

    def __init__(self, scenario: Scenario | str | Path | None = None, action: Action = "residual") -> None:
        """Stands the robot on its reference.

        Args:
            scenario: The scenario or the path of its file; by default one lap of the default scenario.
            action: Meaning of an action, as for `mrctl.envs.episodes.Episodes`.

        Raises:
            InputError: The file or the scenario is invalid.
        """
        self.episodes = Episodes([read(scenario)], action)
        # Each environment has copies, because a space holds its own random numbers.
        self.observation_space, self.action_space = copy.deepcopy((OBSERVATION, ACTION))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Seed of the scenario; by default the environment's own generator draws one.
            options: Not used.

        Returns:
            The observation, `(14,)`, and an empty dictionary.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(SEEDS))
        self.episodes.begin_all([drawn if seed is None else seed % SEEDS])
        return self.episodes.observe()[0][0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Runs one control period.

        Args:
            action: The action as a share of the bound, `(2,)`.

        Returns:
            Observation `(14,)`, reward, whether the robot has failed, whether the scenario is at its end, and a
            dictionary with the reason under `failure` where the robot has failed.
        """
        loop = self.episodes
        loop.act(action * loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            (seen,), (reward,) = loop.observe()
        (terminated,), (truncated,) = loop.ended()
        info = {"failure": loop.plant.failure[0]} if terminated else {}
        return seen, float(reward), bool(terminated), bool(truncated), info


class TrackingVectorEnv(VectorEnv):
    """An environment of many robots in a batch; where an episode is over, the next step begins another."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | Sequence[Scenario] | None = None,
        action: Action = "residual",
        threads: int = 0,
    ) -> None:
        """Stands the robots on their references.

        Args:
            num_envs: Number of robots B.
            scenario: The scenario of all robots or the path of its file, or a sequence of B scenarios; by default one
                lap of the default scenario.
            action: Meaning of an action, as for `mrctl.envs.episodes.Episodes`.
            threads: Number of threads of the batch engine; 0 for all cores.

        Raises:
            InputError: The file or a scenario is invalid, or the scenarios cannot run together.
            ValueError: The number of scenarios is not B.
        """
        if scenario is None or isinstance(scenario, Scenario | str | Path):
            scenarios = [read(scenario)] * num_envs
        else:
            scenarios = list(scenario)
        if len(scenarios) != num_envs:
            raise ValueError(f"num_envs: {num_envs}, but {len(scenarios)} scenarios")
        self.num_envs = num_envs
        self.episodes = Episodes(scenarios, action, threads=threads)
        self.single_observation_space, self.single_action_space = copy.deepcopy((OBSERVATION, ACTION))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._randoms = [seeding.np_random()[0] for _ in scenarios]
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begins an episode of every robot.

        Args:
            seed: A seed, to which each robot's row is added, or B seeds; a robot without a seed draws its own.
            options: Not used.

        Returns:
            The observations, `(B, 14)`, and an empty dictionary.
        """
        if isinstance(seed, Sequence):
            seeds = list(seed)
        else:
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        for row, own in enumerate(seeds):
            if own is not None:
                self._randoms[row] = seeding.np_random(own)[0]
        drawn = [self._draw(row) for row in range(self.num_envs)]
        self.episodes.begin_all([d if s is None else s % SEEDS for s, d in zip(seeds, drawn, strict=True)])
        self._over[:] = False
        return self.episodes.observe()[0], {}

    def _draw(self, row: int) -> int:
        """Draws the seed of a robot's next episode."""
        return int(self._randoms[row].integers(SEEDS))

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool], NDArray[np.bool], dict[str, Any]]:
        """Runs one control period of every robot; a robot whose episode was over begins another, with reward 0.

        Args:
            actions: The actions as shares of the bound, `(B, 2)`.

        Returns:
            Observations `(B, 14)`, rewards `(B,)`, which robots have failed `(B,)`, which are at the end of their
            scenario `(B,)`, and a dictionary with the reasons under `failure`.
        """
        loop, begun = self.episodes, np.flatnonzero(self._over)
        loop.act(actions * loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            for row in begun:
                loop.begin(int(row), self._draw(int(row)))
            seen, reward = loop.observe()
        reward[begun] = 0.0
        terminated, truncated = loop.ended()
        self._over = terminated | truncated
        info: dict[str, Any] = {}
        for row in np.flatnonzero(terminated):
            info = self._add_info(info, {"failure": loop.plant.failure[row]}, int(row))
        return seen, reward, terminated, truncated, info


for _action in ACTION_KINDS:
    gymnasium.register(
        id=f"mrctl/{_action.capitalize()}Tracking-v0",
        entry_point="mrctl.envs.gym:TrackingEnv",
        vector_entry_point="mrctl.envs.gym:TrackingVectorEnv",
        kwargs={"action": _action},
    )
