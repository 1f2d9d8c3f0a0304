"""Model predictive path integral control: a mean of many random twists, in which those of cheap roll-outs weigh most.

Williams, Aldrich and Theodorou, "Model predictive path integral control: from theory to parallel computation", Journal
of Guidance, Control, and Dynamics 40(2), 2017. With costs S of K roll-outs the twists are Σ w u, w ∝ exp(−S/λ). Every
limit is a convex set of twists, so their mean keeps it. Unlike in the paper, the cost has no term of control effort.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.reactive import Reactive
from mrctl.navigation.replanning import Replan
from mrctl.navigation.rollouts import KNOTS, STEPS, TOUCH_COST, Considered, Scene, roll_out
from mrctl.record import InputError
from mrctl.theory.robot import Robot

SAMPLES = 2000
TEMPERATURE = 0.1  # λ, in units of the cost; chosen
ORDINARY_SPEED = 0.8  # m/s; for smaller largest V, λ falls as V², as the differences of the costs do; chosen
MAX_COST_DIFFERENCE = 40  # λ, that a sample may cost more than another one and still weigh something: exp(−40) is 4e-18
SHOWN_SAMPLES = 40  # of the samples, which are kept to be looked at
SAMPLE_DEVIATIONS = 0.25, 0.3  # standard deviations of what is added, over the largest V and θ̇; chosen
LAG = 0.06  # s, of the roll-outs by default, two to three times that of the robots; chosen
MAX_LAG = 10.0  # s
KNOT_STEPS = np.linspace(0, STEPS - 1, KNOTS).round().astype(int)  # the steps nearest to the knots
MAX_LEFT = 0.5  # share of the way to its target that may be left at the end of a roll-out that gets on; chosen


class Mppi(Reactive):
    """A motion stage that samples twists around those of the period before; the same noise for every robot."""

    def __init__(self, robot: Robot, size: int, replan: Replan, lag: float = LAG) -> None:
        """Takes the arguments of `Reactive`, and the lag that the roll-outs assume.

        Args:
            robot: The nominal robot.
            size: Number of robots.
            replan: Makes a plan to the goal.
            lag: Time constant in s with which V and θ̇ follow what is requested; 0: at once.

        Raises:
            InputError: The lag is negative or too large.
        """
        if not 0 <= lag <= MAX_LAG:
            raise InputError(f"lag: must be between 0 and {MAX_LAG:g} s, not {lag:g}")
        super().__init__(robot, size, replan)
        self._lag = lag

    def reset(self, pose: Array, reference: Array, period: float) -> None:
        """Starts a run; the arguments are those of `mrctl.control.stages.MotionStage`."""
        super().reset(pose, reference, period)
        self._nominal = np.zeros((len(pose), STEPS, 2))
        self._twists, self._costs = np.empty((SAMPLES, STEPS, 2)), np.empty(SAMPLES)

    def begin(self, tick: int) -> None:
        """Draws the noise of a period, whose number is the only seed."""
        self._noise = np.random.default_rng(tick).standard_normal((SAMPLES, KNOTS, 2))

    def passes(self, row: int, period: float, scene: Scene) -> bool:
        """Tells whether the chosen twists, obeyed at once, at least halve the distance of the robot from its target."""
        considered = self.considered[row]
        assert considered is not None
        way, target = considered.paths(period)[1], scene.targets[-1, :2]
        left, before = (float(np.hypot(*(target - place))) for place in (way[-1], way[0]))
        return left < MAX_LEFT * before

    def choose(self, row: int, pose: Array, twist: Array, last: Array, period: float, scene: Scene) -> Array:
        """Returns the first of the mean twists, or of the cheapest sample where only the mean touches an obstacle."""
        nominal, twists, costs, bounds = self._nominal[row], self._twists, self._costs, self.bounds[row]
        knots = self._noise * (np.array(SAMPLE_DEVIATIONS) * (bounds.speed, bounds.rotation))
        nominal[:-1] = nominal[1:].copy()  # a period has passed
        knots[0] = 0.0  # one roll-out is nominal, and another brakes
        knots[1] = -bounds.speed, 0.0
        # One drives about as the plan, else a robot would go on standing where that is a loop which ends near it: all
        # others lead away at first. But the plan knows nothing of what moves, and leads nearer to it.
        if not scene.movers[:, 2:4].any():
            knots[2] = (twists_along(scene.targets, period) - nominal)[KNOT_STEPS]
        state = pose, twist, last, self._lag, period, bounds, scene
        temperature = TEMPERATURE * min(1.0, bounds.speed / ORDINARY_SPEED) ** 2
        worth = MAX_COST_DIFFERENCE * temperature
        roll_out.compiled(knots, nominal, *state, worth, twists, costs)
        weights = np.exp((costs.min() - costs) / temperature)
        mean = (weights[:, None, None] / weights.sum() * twists).sum(axis=0)  # BLAS adds in an order of its own
        cheapest, some = twists[costs.argmin()].copy(), twists[:: SAMPLES // SHOWN_SAMPLES].copy()
        touches = costs.min() >= TOUCH_COST
        roll_out.compiled(knots[:1], mean, *state, worth, twists[:1], costs[:1])
        nominal[:] = mean if touches or costs[0] < TOUCH_COST else cheapest
        self.considered[row] = Considered(pose.copy(), some, nominal.copy(), last.copy())
        return nominal[0]


def twists_along(targets: Array, period: float) -> Array:
    """Returns the twist with which each target is reached from the one before, V in m/s and θ̇ in rad/s, `(n, 2)`.

    The first target, which has none before it, gets the twist of the second.

    Args:
        targets: As those of `Scene`.
        period: Time from one to the next in s.
    """
    (cos, sin), (before, after) = targets[:, 2:].T, (targets[:-1], targets[1:])
    turned = np.arctan2(cos[:-1] * sin[1:] - sin[:-1] * cos[1:], cos[:-1] * cos[1:] + sin[:-1] * sin[1:])
    twists = np.column_stack([np.hypot(*(after - before)[:, :2].T), turned]) / period
    return np.concatenate([twists[:1], twists])
