"""Tracking and navigation as Gymnasium environments, for one robot or a batch; needs `pip install 'mrctl[env]'`.

The import of this module registers `mrctl/TwistTracking-v0`, `mrctl/VoltageTracking-v0`, `mrctl/ResidualTracking-v0`
and `mrctl/Navigation-v0`. An action is that of `mrctl.envs.episodes.Episodes` divided by `bound`, so that it lies
between −1 and 1. An observation holds the parts in `sizes` one after another. The seed of a reset becomes the seed of
the scenario: with a residual of zero the episode has the same bits as `simulate` with that seed and `pid.retune` off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

from mrctl.envs.episodes import ACTION_KINDS, MAX_SEEDS, Action, Draw, Episodes, read
from mrctl.envs.navigation import Navigating, read_mission
from mrctl.envs.pictures import Pictures
from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.scenario import Scenario

RENDER_MODES = ["rgb_array"]


def _spaces(episodes: Episodes) -> tuple[Box, Box]:
    """Makes the spaces of observations and actions; each environment needs its own, as they hold random generators."""
    low, high = episodes.limits
    return Box(low, high, dtype=np.float64), Box(-1.0, 1.0, (2,), np.float64)


def _pictures(episodes: Episodes, render_mode: str | None) -> Pictures | None:
    """Returns what draws the robots in a render mode.

    Raises:
        InputError: There is no such mode.
    """
    if render_mode not in (None, *RENDER_MODES):
        raise InputError(f"render_mode: {render_mode!r} is not rgb_array")
    return Pictures(episodes) if render_mode else None


def asked(options: dict[str, Any] | None) -> Any:  # noqa: ANN401
    """Returns the perturbation in the options of a reset, or None.

    Raises:
        InputError: The options are no dictionary, or there is another one.
    """
    options = {} if options is None else options
    if not isinstance(options, dict):
        raise InputError("options: must be a dictionary, such as {'perturbation': 'all'}")
    for name in options.keys() - {"perturbation"}:
        raise InputError(f"options: there is no {name!r}, only perturbation")
    return options.get("perturbation")


class TrackingEnv(gymnasium.Env):
    """An environment in which one robot follows the reference of a scenario."""

    metadata = {"render_modes": RENDER_MODES, "render_fps": 100}

    def __init__(
        self,
        scenario: Scenario | str | Path | None = None,
        action: Action = "residual",
        draw: Draw | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Stands the robot on its reference.

        Args:
            scenario: The scenario or the path of its file; by default one lap of the default scenario.
            action: Meaning of an action, as for `mrctl.envs.episodes.Episodes`.
            draw: Draws the perturbation of every episode from a `numpy.random.Generator`, which the episode's seed
                determines; by default every episode has that of the scenario.
            render_mode: `rgb_array` for pictures, or None.

        Raises:
            InputError: The file or the scenario is invalid, or there is no such `render_mode`.
        """
        self._set_up(Episodes([read(scenario)], action, draw=draw), render_mode)

    def _set_up(self, episodes: Episodes, render_mode: str | None) -> None:
        """Takes the closed loop and the way to draw."""
        self.episodes, self.render_mode, self._pictures = episodes, render_mode, _pictures(episodes, render_mode)
        self.metadata = {**self.metadata, "render_fps": round(1 / episodes.period)}
        self.observation_space, self.action_space = _spaces(episodes)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Seed of the scenario; by default the environment's own generator draws one.
            options: The `perturbation` of this episode: a `Perturbation`, a mapping of its fields, or one of the names
                in `PERTURBATIONS`; by default `draw` draws it, or it is that of the scenario.

        Returns:
            The observation, `(n,)`, and an empty dictionary.

        Raises:
            InputError: An option is unknown or invalid, or no scenario can have the seed.
            gymnasium.error.Error: The seed is negative or no integer.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(MAX_SEEDS))
        self.episodes.begin_all([drawn if seed is None else seed], [asked(options)])
        return self.episodes.observe()[0][0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Runs one control period.

        Args:
            action: The action as a share of the bound, `(2,)`.

        Returns:
            Observation `(n,)`, reward, whether the robot has failed or arrived, whether the scenario is at its end, and
            a dictionary, which is empty before the end of the episode. Then it holds the errors of the episode as
            `v_rmse`, `omega_rmse` and `position_rmse` in m/s, rad/s and m, NaN after a failure, but in `NavigationEnv`
            none of them; and `failure` if the robot has failed or arrived: the reason, or "" for an arrival.

        Raises:
            InputError: The action has another shape, or holds no real numbers.
        """
        loop = self.episodes
        loop.act(action, loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            (seen,), (reward,) = loop.observe()
        (terminated,), (truncated,) = loop.ended()
        info: dict[str, Any] = {"failure": loop.failure(0)} if terminated else {}
        if terminated or truncated:
            info |= loop.metrics(0)
        return seen, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture of the robot in its world, `(480, 640, 3)`; None without `render_mode`.

        Raises:
            InputError: MuJoCo cannot draw on this machine.
        """
        return self._pictures.draw() if self._pictures else None


class NavigationEnv(TrackingEnv):
    """An environment in which one robot with a lidar gets a goal."""

    def __init__(
        self,
        scenario: Scenario | str | Path | None = None,
        draw: Draw | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Stands the robot at its start.

        Args:
            scenario: The scenario, with a goal, or the path of its file; by default a mission through a door.
            draw: As for `TrackingEnv`.
            render_mode: As for `TrackingEnv`.

        Raises:
            InputError: The file or the scenario is invalid.
        """
        self._set_up(Navigating([read_mission(scenario)], draw=draw), render_mode)


class TrackingVectorEnv(VectorEnv):
    """An environment of many robots in a batch; the step after the end of an episode begins another."""

    metadata = {"render_modes": RENDER_MODES, "render_fps": 100, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | Sequence[Scenario] | None = None,
        action: Action = "residual",
        threads: int = 0,
        draw: Draw | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Stands the robots on their references.

        Args:
            num_envs: Number of robots B.
            scenario: The scenario of all robots or the path of its file, or a sequence of B scenarios; by default one
                lap of the default scenario.
            action: Meaning of an action, as for `mrctl.envs.episodes.Episodes`.
            threads: Number of threads of the batch engine; 0 for all cores.
            draw: As for `TrackingEnv`.
            render_mode: As for `TrackingEnv`.

        Raises:
            InputError: The file or a scenario is invalid, the number of scenarios is not B, the scenarios cannot run
                together, or there is no such `render_mode`.
        """
        self._set_up(Episodes(_several(num_envs, scenario, read), action, draw=draw, threads=threads), render_mode)

    def _set_up(self, episodes: Episodes, render_mode: str | None) -> None:
        """Takes the closed loop and the way to draw."""
        self.episodes, num_envs = episodes, len(episodes.scenarios)
        self.render_mode, self._pictures = render_mode, _pictures(episodes, render_mode)
        self.metadata = {**self.metadata, "render_fps": round(1 / episodes.period)}
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._randoms = [seeding.np_random()[0] for _ in episodes.scenarios]
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begins an episode of every robot.

        Args:
            seed: A seed, to which each robot's row is added, or B seeds; a robot without a seed draws its own.
            options: The `perturbation` of these episodes, as for `TrackingEnv`, or a list of B of them.

        Returns:
            The observations, `(B, n)`, and an empty dictionary.

        Raises:
            InputError: An option is unknown or invalid, no scenario can have a seed, or there are not as many seeds as
                robots.
        """
        if isinstance(seed, np.ndarray | np.integer):
            seed = seed.tolist()
        if isinstance(seed, Sequence):
            seeds = [own.item() if isinstance(own, np.integer) else own for own in seed]
            if len(seeds) != self.num_envs:
                raise InputError(f"seed: {len(seeds)} seeds for {self.num_envs} robots")
        else:
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        for row, own in enumerate(seeds):
            if own is not None:
                self._randoms[row] = seeding.np_random(own)[0]
        drawn = [self._draw(row) for row in range(self.num_envs)]
        perturbation = asked(options)
        several = perturbation if isinstance(perturbation, list | tuple) else [perturbation] * self.num_envs
        self.episodes.begin_all([d if s is None else s for s, d in zip(seeds, drawn, strict=True)], several)
        self._over[:] = False
        return self.episodes.observe()[0], {}

    def _draw(self, row: int) -> int:
        """Draws the seed of a robot's next episode."""
        return int(self._randoms[row].integers(MAX_SEEDS))

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool], NDArray[np.bool], dict[str, Any]]:
        """Runs one control period of every robot; a robot whose episode was over begins another, with reward 0.

        Args:
            actions: The actions as shares of the bound, `(B, 2)`.

        Returns:
            Observations `(B, n)`, rewards `(B,)`, which robots have failed or arrived `(B,)`, which are at the end of
            their scenario `(B,)`, and a dictionary like that of `TrackingEnv`, of arrays `(B,)`.

        Raises:
            InputError: As for `TrackingEnv`.
        """
        loop, begun = self.episodes, np.flatnonzero(self._over)
        loop.act(actions, loop.bound)
        with np.errstate(invalid="ignore", over="ignore"):
            loop.step()
            for row in begun:
                loop.begin(int(row), self._draw(int(row)))
            seen, reward = loop.observe()
        reward[begun] = 0.0
        terminated, truncated = loop.ended()
        self._over = terminated | truncated
        info: dict[str, Any] = {}
        for row in map(int, np.flatnonzero(self._over)):
            reason = {"failure": loop.failure(row)} if terminated[row] else {}
            info = self._add_info(info, reason | loop.metrics(row), row)
        return seen, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns a picture of each robot, `(480, 640, 3)`, in which the others are not drawn; see `TrackingEnv`."""
        return tuple(map(self._pictures.draw, range(self.num_envs))) if self._pictures else None


class NavigationVectorEnv(TrackingVectorEnv):
    """Navigation of many robots in a batch, each of which may have a world of its own."""

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | Sequence[Scenario] | None = None,
        threads: int = 0,
        draw: Draw | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Stands the robots at their starts.

        Args:
            num_envs: Number of robots B.
            scenario: As for `NavigationEnv`, or a sequence of B scenarios, which may differ in start, goal, length and
                obstacles. The numbers of moving obstacles and the corners of polygons must be the same.
            threads: Number of threads of the batch engine; 0 for all cores.
            draw: As for `TrackingEnv`.
            render_mode: As for `TrackingEnv`.

        Raises:
            InputError: As for `TrackingVectorEnv`.
        """
        self._set_up(Navigating(_several(num_envs, scenario, read_mission), draw=draw, threads=threads), render_mode)


def _several(
    count: int,
    scenario: Scenario | str | Path | Sequence[Scenario] | None,
    read: Callable[[Scenario | str | Path | None], Scenario],
) -> list[Scenario]:
    """Returns a scenario for each of `count` robots.

    Raises:
        InputError: There is no robot, the number of given scenarios is another one, or one of them is none.
    """
    if count < 1:
        raise InputError(f"num_envs: {count} is below 1")
    if isinstance(scenario, str | Path) or not isinstance(scenario, Sequence):
        return [read(scenario)] * count
    if len(scenario) != count:
        raise InputError(f"num_envs: {count}, but {len(scenario)} scenarios")
    return [read(one) for one in scenario]


gymnasium.register(
    id="mrctl/Navigation-v0",
    entry_point="mrctl.envs.gym:NavigationEnv",
    vector_entry_point="mrctl.envs.gym:NavigationVectorEnv",
)
for _action in ACTION_KINDS:
    gymnasium.register(
        id=f"mrctl/{_action.capitalize()}Tracking-v0",
        entry_point="mrctl.envs.gym:TrackingEnv",
        vector_entry_point="mrctl.envs.gym:TrackingVectorEnv",
        kwargs={"action": _action},
    )
