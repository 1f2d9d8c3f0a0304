"""Writes a `Perturbation` into a compiled model, and copies the fields that it changes from model to model."""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array
from mrctl.physics.elements import MOTORS, REAR, bodies_of, left_tyre_pairs, rolling_fronts
from mrctl.physics.parameters import at_rest, load_torques, read_robot
from mrctl.physics.readout import current_limits
from mrctl.record import InputError
from mrctl.theory.drive import NO_LIMIT
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import Robot

PERTURBED = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "actuator_gainprm",
    "actuator_dynprm",
    "actuator_ctrlrange",
    "actuator_forcelimited",
    "actuator_forcerange",
    "pair_friction",
    "dof_frictionloss",
    "numeric_data",
    "opt.gravity",
)
"""The fields of a model that `perturb` and `limit_current` write, as `mujoco.batch` names them."""


def perturb(
    nominal: mujoco.MjModel,
    model: mujoco.MjModel,
    perturbation: Perturbation,
    robot: Robot | None = None,
    scratch: mujoco.MjData | None = None,
) -> None:
    """Writes the nominal model, changed by a perturbation, into another model, and recomputes its constants.

    What an earlier perturbation changed in that model is undone. The rolling loss in a wheel's frictionloss grows with
    the static load on the wheel. `limit_current` writes the current limit. A model has no fields for the rest of the
    driver, for the steering servo and for delay, which `mrctl.physics.plant` applies.

    Args:
        nominal: The nominal model, which is only read.
        model: A copy of it, which is written.
        perturbation: The complete perturbation.
        robot: The parameters of the nominal model, if known; by default they are read from it.
        scratch: As for `at_rest`.

    Raises:
        InputError: The perturbed robot could not stand, because its centre of mass lies outside its wheels or below the
            ground.
    """
    p = perturbation
    scratch = scratch or mujoco.MjData(nominal)
    robot = robot or read_robot(nominal, scratch=scratch)
    before = load_torques(nominal, scratch)
    shares = _loss_shares(nominal, robot, before)
    _perturb_bodies(nominal, model, p, robot.wheel_radius)
    _perturb_wheels(nominal, model, p)
    _perturb_motors(nominal, model, p, shares)
    model.pair_friction[:] = nominal.pair_friction
    model.pair_friction[:, :2] *= p.tyre_friction_factor
    model.pair_friction[left_tyre_pairs(nominal), :2] *= p.left_tyre_friction_factor
    gx, gy, gz = nominal.opt.gravity
    c, s = np.cos(p.slope), np.sin(p.slope)
    model.opt.gravity[:] = c * gx + s * gz, gy, c * gz - s * gx
    after = load_torques(model, scratch)
    if min(after.values()) <= 0:
        raise InputError("perturbation.payload: the centre of mass lies outside the wheels; the robot would tip over")
    height = at_rest(model, scratch)[1][2] + np.mean([model.geom(wheel).size[0] for wheel in REAR])
    if height < 0:
        raise InputError("perturbation.payload_z: the centre of mass lies below the ground")
    more: dict[str, float] = dict(zip(REAR, robot.drive_loss * shares * (_drive_frictions(p) - 1), strict=True))
    for wheel in (*REAR, *rolling_fronts(nominal)):
        dof = nominal.joint(wheel).dofadr[0] + np.arange(len(nominal.joint(wheel).frictionloss))
        rolling = robot.rolling_coefficient * (after[wheel] - before[wheel])
        model.dof_frictionloss[dof] = nominal.dof_frictionloss[dof] + more.get(wheel, 0.0) + rolling
    mujoco.mj_setConst(model, scratch)


def _perturb_bodies(nominal: mujoco.MjModel, model: mujoco.MjModel, p: Perturbation, wheel_radius: float) -> None:
    """Writes masses and inertias, with the payload on the chassis."""
    chassis, bodies = nominal.body("chassis").id, bodies_of(nominal)
    model.body_mass[:] = nominal.body_mass
    model.body_inertia[:] = nominal.body_inertia
    model.body_mass[bodies] *= p.mass_factor
    model.body_inertia[bodies] *= p.mass_factor
    model.body_ipos[chassis] = nominal.body_ipos[chassis]
    model.body_iquat[chassis] = nominal.body_iquat[chassis]
    if p.inertia_factor != 1:
        _scale_yaw_inertia(model, chassis, p.inertia_factor)
    if p.payload > 0:
        position = np.array([p.payload_x, p.payload_y, p.payload_z - wheel_radius])
        _add_point_mass(model, chassis, p.payload, position)


def _perturb_wheels(nominal: mujoco.MjModel, model: mujoco.MjModel, p: Perturbation) -> None:
    """Writes the radii of the driven wheels."""
    for wheel, factor in (("wheel_left", p.left_radius_factor), ("wheel_right", p.right_radius_factor)):
        geom = nominal.geom(wheel).id
        model.geom_size[geom] = nominal.geom_size[geom] * factor
        model.geom_rbound[geom] = nominal.geom_rbound[geom] * factor
        model.geom_aabb[geom] = nominal.geom_aabb[geom] * factor


def _perturb_motors(nominal: mujoco.MjModel, model: mujoco.MjModel, p: Perturbation, shares: Array) -> None:
    """Writes resistances, motor constants and supply of the motors, and their no-load current.

    Args:
        nominal: The nominal model.
        model: The model that is written.
        p: The perturbation.
        shares: Those of `_loss_shares`, `(2,)`.
    """
    motors = [nominal.actuator(name).id for name in MOTORS]
    resistance = p.resistance_factor * np.array([p.left_resistance_factor, p.right_resistance_factor])
    constant = p.motor_constant_factor * np.array([p.left_motor_constant_factor, p.right_motor_constant_factor])
    model.actuator_gainprm[motors] = nominal.actuator_gainprm[motors]
    model.actuator_gainprm[motors, 0] *= resistance
    model.actuator_gainprm[motors, 1] *= constant
    # A <dcmotor> holds L/R; the winding keeps its inductance L when its resistance changes.
    model.actuator_dynprm[motors] = nominal.actuator_dynprm[motors]
    model.actuator_dynprm[motors, 0] /= resistance
    inputs = nominal.actuator_ctrladr[motors]
    model.actuator_ctrlrange[inputs] = nominal.actuator_ctrlrange[inputs] * max(1.0, p.supply_factor)
    # The no-load torque k_M I_0 is a loss: it grows with the drive friction, and not with the motor constant. The model
    # holds one current, with which the mean constant of the two motors gives their mean loss.
    no_load = nominal.numeric("no_load_current").data * (shares * _drive_frictions(p)).mean() / constant.mean()
    model.numeric("no_load_current").data[:] = no_load


def _loss_shares(nominal: mujoco.MjModel, robot: Robot, loads: dict[str, float]) -> Array:
    """Returns the losses of the left and the right drive over their mean, which is `drive_loss`, `(2,)`.

    Args:
        nominal: The nominal model.
        robot: Its parameters.
        loads: Its `load_torques`, to which the rolling loss of a wheel is proportional.
    """
    if robot.drive_loss == 0:
        return np.ones(2)
    left, right = (nominal.joint(w).frictionloss[0] - robot.rolling_coefficient * loads[w] for w in REAR)
    return 1 + (left - right) / (2 * robot.drive_loss) * np.array([1.0, -1.0])


def _drive_frictions(p: Perturbation) -> Array:
    """Returns the factors on the friction of the left and the right drive, `(2,)`."""
    return p.drive_friction_factor * np.array([p.left_drive_friction_factor, p.right_drive_friction_factor])


def limit_current(nominal: mujoco.MjModel, model: mujoco.MjModel, limit: float) -> None:
    """Limits the currents of both motors, by the limit k_M I on the torque of each `<dcmotor>`.

    Args:
        nominal: The nominal model; the lower of its own limit and `limit` holds.
        model: The perturbed model, which is written.
        limit: Largest current I in A; with `NO_LIMIT` only the model's own limit holds.
    """
    motors = [nominal.actuator(name).id for name in MOTORS]
    currents = np.minimum(current_limits(nominal), limit if limit < NO_LIMIT else np.inf)
    model.actuator_forcelimited[motors] = limited = np.isfinite(currents)
    torque = np.where(limited, currents, 0.0) * model.actuator_gainprm[motors, 1]
    model.actuator_forcerange[motors] = np.array([-torque, torque]).T


def _scale_yaw_inertia(model: mujoco.MjModel, body: int, factor: float) -> None:
    """Multiplies the inertia of a body about the z axis of its frame, and what couples it to others by the root.

    The tensor so stays positive definite.
    """
    frame = _principal_axes(model, body)
    axis = int(np.argmax(np.abs(frame[2])))
    if abs(frame[2, axis]) > 1 - 1e-9:
        model.body_inertia[body, axis] *= factor
        return
    tensor = frame * model.body_inertia[body] @ frame.T
    tensor[2] *= np.sqrt(factor)
    tensor[:, 2] *= np.sqrt(factor)
    _write_inertia(model, body, tensor)


def _principal_axes(model: mujoco.MjModel, body: int) -> Array:
    """Returns the principal axes of a body in its frame, one in each column, `(3, 3)`."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    return frame.reshape(3, 3)


def _write_inertia(model: mujoco.MjModel, body: int, tensor: Array) -> None:
    """Writes an inertia tensor about the centre of mass in the body's frame, `(3, 3)`, as MuJoCo stores it."""
    principal, axes = np.linalg.eigh(tensor)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    model.body_inertia[body], model.body_iquat[body] = principal, quat


def _add_point_mass(model: mujoco.MjModel, body: int, mass: float, position: Array) -> None:
    """Adds a point mass in kg to a body, at a position `(3,)` in m in the body's frame.

    The parallel-axis theorem gives the tensor about the new centre of mass, whose principal axes MuJoCo stores.
    """
    own = model.body_mass[body]
    frame = _principal_axes(model, body)
    own_centre = model.body_ipos[body].copy()
    total = own + mass
    centre = (own * own_centre + mass * position) / total
    tensor = frame * model.body_inertia[body] @ frame.T
    for m, point in ((own, own_centre), (mass, position)):
        d = point - centre
        tensor = tensor + m * (d @ d * np.eye(3) - np.outer(d, d))
    model.body_mass[body] = total
    model.body_ipos[body] = centre
    _write_inertia(model, body, tensor)


def fields(model: mujoco.MjModel) -> dict[str, NDArray]:
    """Returns copies of the fields named in `PERTURBED`, by name."""
    return {name: np.array(_get(model, name)) for name in PERTURBED}


def _get(model: mujoco.MjModel, name: str) -> NDArray:
    """Returns a view of a field; the names of fields of the options begin with `opt.`."""
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def write(model: mujoco.MjModel, values: Mapping[str, NDArray], scratch: mujoco.MjData) -> None:
    """Writes fields, as `fields` returns them, into a model and recomputes the constants that follow from them.

    Args:
        model: The model.
        values: The fields by name.
        scratch: As for `at_rest`.
    """
    for name, value in values.items():
        _get(model, name)[...] = value
    mujoco.mj_setConst(model, scratch)
