"""The dynamic window: of the twists that the robot can reach in a moment, the one whose constant course costs least.

Fox, Burgard and Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics and Automation Magazine
4(1), 1997. Their objective rewards heading, clearance and speed; here it is the cost of a roll-out along the plan. A
twist is admissible if the robot can set out towards it and then brake without touching an obstacle; those come first
that also keep off what the map lacks. If none is admissible, the robot brakes as hard as it can, with the θ̇ of the
cheapest of these roll-outs.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array
from mrctl.navigation.reactive import Reactive
from mrctl.navigation.rollouts import KNOTS, STEPS, TOUCH_COST, Considered, Scene, roll_out

SPEED_SAMPLES, ROTATION_SAMPLES = np.linspace(-1, 1, 9), np.linspace(-1, 1, 15)  # of the window
REACH_TIME = 0.25  # s, in which the twists of the window can be reached
LOOK_STEPS = 12  # steps, over which a constant twist is looked at; chosen, like the next two
# 1/s, `Scene.near`; with more a robot stops before gaps, as it comes nearer to its plan so slowly
NEARNESS_WEIGHT = 1.25
# m, by which what the robot has found beside its map is enlarged: a roll-out neither knows the noise of the lidar, nor
# how the robot departs from the twist, nor the side of an obstacle that no scan has shown yet. Chosen.
UNMAPPED_TWIST_MARGIN = 0.05


class Window(Reactive):
    """A motion stage that keeps the best constant twist."""

    def choose(self, row: int, pose: Array, twist: Array, last: Array, period: float, scene: Scene) -> Array:
        """Returns the first twist towards the best one of the window."""
        bounds = self.bounds[row]
        reach, turn = REACH_TIME * bounds.acceleration, REACH_TIME * bounds.rotation_acceleration
        # Signed squares lie closest about the last twist: between samples at equal distances a robot oscillates.
        speeds = np.clip(last[0] + reach * SPEED_SAMPLES * abs(SPEED_SAMPLES), 0.0, bounds.speed)
        rotations = last[1] + turn * ROTATION_SAMPLES * abs(ROTATION_SAMPLES)
        rotations = np.clip(rotations, -bounds.rotation, bounds.rotation)
        grid = np.stack(np.meshgrid(speeds, rotations), -1).reshape(-1, 1, 2)
        constant = np.repeat(grid, KNOTS, axis=1)
        falling = constant * np.array([1.0, *[0.0] * (KNOTS - 1)])[:, None]
        falling[:, :, 1] = constant[:, :, 1]  # the curvature bounds θ̇ as V falls

        def rolled_out(knots: Array, scene: Scene) -> tuple[Array, Array]:
            """Returns twists and costs of roll-outs that are as long as the targets of a scene."""
            steps = len(scene.targets)
            twists, costs = np.empty((len(knots), steps, 2)), np.empty(len(knots))
            state = pose, twist, last, 0.0, period, bounds, scene
            roll_out.compiled(knots, np.zeros((steps, 2)), *state, np.inf, twists, costs)
            return twists, costs

        # A constant twist would rather stop before the goal than be turned there.
        scene = scene._replace(end=STEPS, near=NEARNESS_WEIGHT)
        ahead, costs = rolled_out(constant, scene._replace(targets=scene.targets[:LOOK_STEPS]))
        stops, braking = rolled_out(falling, scene)
        costs[braking >= TOUCH_COST] = np.inf
        if len(scene.movers):
            wide = scene.movers + np.array([0.0, 0.0, 0.0, 0.0, UNMAPPED_TWIST_MARGIN])
            costs[rolled_out(falling, scene._replace(movers=wide))[1] >= TOUCH_COST] += TOUCH_COST
        best = int(costs.argmin())
        hard = np.where(grid[:, 0, 0] == speeds[0], braking, np.inf)
        chosen = ahead[best] if np.isfinite(costs[best]) else stops[int(hard.argmin())]
        self.considered[row] = Considered(pose.copy(), ahead, chosen, last.copy())
        return chosen[0]
