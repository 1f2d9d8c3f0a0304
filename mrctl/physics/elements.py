"""Names of the elements that a compiled robot has, and look-ups by name."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

REAR = ("wheel_left", "wheel_right")

MOTORS = ("motor_left", "motor_right")

# What else a robot may stand on: one steered wheel, two, or casters.
FRONTS = ("front_wheel", "front_left", "front_right", "caster_left", "caster_right")

RIGID = "servo_steering"  # text in a model whose wheels are steered by servos, not by the road



def has(model: mujoco.MjModel, kind: str, name: str) -> bool:
    """Whether a model has an element of that name."""
    return mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name) >= 0



def fronts(model: mujoco.MjModel) -> list[str]:
    """What else the robot stands on: geoms of one front wheel, of two, or of casters."""
    return [name for name in FRONTS if has(model, "geom", name)]



def rolling_fronts(model: mujoco.MjModel) -> list[str]:
    """Those of `fronts` that roll instead of sliding."""
    return [name for name in fronts(model) if has(model, "joint", name)]



def bodies_of(model: mujoco.MjModel) -> list[int]:
    """The bodies of the robot."""
    chassis = model.body("chassis").id
    return [body for body in range(model.nbody) if model.body_rootid[body] == chassis]



def centres(model: mujoco.MjModel, data: mujoco.MjData, wheels: Sequence[str]) -> NDArray[np.float64]:
    """Centres of wheels from P in the chassis' frame, `(n, 3)` in m, to the picometre."""
    chassis = data.body("chassis")
    return np.array([rounded(chassis.xmat.reshape(3, 3).T @ (data.geom(w).xpos - chassis.xpos)) for w in wheels])



def rounded(position: NDArray) -> NDArray:
    """Positions in m to the picometre."""
    return np.round(position, 12)  # 0.40 − 0.37 is 0.03



def tyre_pairs(model: mujoco.MjModel) -> list[int]:
    """The contact pairs of the rear left wheel, the named tyre pair first."""
    wheel = model.geom("wheel_left").id
    pairs = [p for p in range(model.npair) if wheel in (model.pair_geom1[p], model.pair_geom2[p])]
    return sorted(pairs, key=lambda p: model.pair(p).name != "tyre_left")
