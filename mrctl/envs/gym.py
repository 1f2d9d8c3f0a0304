"""Tracking as Gymnasium environments, one robot or many on the batch plant: `pip install 'mrctl[env]'`.

Importing this registers `mrctl/TwistTracking-v0`, `mrctl/VoltageTracking-v0` and `mrctl/ResidualTracking-v0`, whose
actions are those of `mrctl.envs.episodes.Episodes` over its `bound`, so from -1 to 1. An observation is what
`OBSERVATIONS` names, side by side. The seed of a reset is the scenario's: the episode has the bits of `simulate` with
that seed.
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

SEEDS = 2**32  # of a scenario


OBSERVATION = Box(-np.inf, np.inf, (sum(OBSERVATIONS.values()),), np.float64)
ACTION = Box(-1.0, 1.0, (2,), np.float64)


class TrackingEnv(gymnasium.Env):
    """One robot that shall follow the reference of a scenario."""

    metadata = {"render_modes": []}

    def __init__(self, scenario: Scenario | str | Path | None = None, action: Action = "residual") -> None:
        """Takes a scenario or its file, by default one lap, and what an action is."""
        self.episodes = Episodes([read(scenario)], action)
        self.observation_space, self.action_space = copy.deepcopy((OBSERVATION, ACTION))  # each has its own generator

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begins an episode, with this seed or one drawn."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(SEEDS))
        self.episodes.begin_all([drawn if seed is None else seed % SEEDS])
        return self.episodes.observe()[0][0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period; terminated where the robot has failed, and the info says why."""
        loop = self.episodes
        loop.act(action * loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            (seen,), (reward,) = loop.observe()
        failed = bool(loop.plant.failed[0])
        info = {"failure": loop.plant.failure[0]} if failed else {}
        return seen, float(reward), failed, bool(loop.over()[0]) and not failed, info


class TrackingVectorEnv(VectorEnv):
    """Many robots on the batch plant; each that ends begins again in the next step, by itself."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | Sequence[Scenario] | None = None,
        action: Action = "residual",
        threads: int = 0,
    ) -> None:
        """Builds the robots.

        Args:
            num_envs: How many.
            scenario: Of all of them, or one each; or a file.
            action: What an action is.
            threads: Of the batch engine; 0 for all cores.

        Raises:
            InputError: As `Episodes`.
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
        """Begins an episode of every robot; robot i has seed + i, or the i-th of several."""
        if isinstance(seed, Sequence):
            seeds = list(seed)
        else:
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        for row, one in enumerate(seeds):
            if one is not None:
                self._randoms[row] = seeding.np_random(one)[0]
        drawn = [self._draw(row) for row in range(self.num_envs)]
        self.episodes.begin_all([d if s is None else s % SEEDS for s, d in zip(seeds, drawn, strict=True)])
        self._over[:] = False
        return self.episodes.observe()[0], {}

    def _draw(self, row: int) -> int:
        return int(self._randoms[row].integers(SEEDS))

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool], NDArray[np.bool], dict[str, Any]]:
        """One control period of every robot; those whose episode was over begin the next, without reward."""
        loop, begun = self.episodes, np.flatnonzero(self._over)
        loop.act(actions * loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            for row in begun:
                loop.begin(int(row), self._draw(int(row)))
            seen, reward = loop.observe()
        reward[begun] = 0.0
        terminated = loop.plant.failed.copy()
        truncated = loop.over() & ~terminated
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
