"""Is the physics right? A robot in MuJoCo, driven open loop, against values worked out by hand.

A check takes a compiled model and the robot that it ought to be. What it expects follows from that `Robot` and from
the laws of `mrctl.theory`, never from the model, so that a model with another gear, mass or friction than it claims
fails. Voltages, speeds and times scale with the robot: any robot that `mrctl.physics.mjcf.load` accepts can be checked.
`CHECKS` lists all of them with the world and the steering arrangement that each one is for.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is compiled and ships no stubs)

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrctl.physics.elements import MOTORS, REAR, fronts, has
from mrctl.physics.mjcf import clone, steerings
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.physics.plant import (
    OMEGA,
    RATE_LEFT,
    RATE_RIGHT,
    STEERING,
    THETA,
    UPRIGHT,
    V_LATERAL,
    V,
    X,
    Y,
    addresses,
    inputs,
    read,
)
from mrctl.physics.stand import stand
from mrctl.theory.dynamics import accelerations, inverse_dynamics
from mrctl.theory.kinematics import scrub_free_angle, twist_from_front_wheel, wheel_rates
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import GRAVITY, Robot, Steering

Array = NDArray[np.float64]
Control = Callable[[float], ArrayLike]  # time in s to left V, right V, steering rad, steering rate rad/s

HOLD = 0.02  # s for which a control is held
BLOWN = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


class Comparison(NamedTuple):
    """One measured number beside the expected one; `tolerance` is absolute, in the same unit."""

    quantity: str
    measured: float
    expected: float
    tolerance: float
    unit: str

    @property
    def passed(self) -> bool:
        """Whether the two are within tolerance; what is no number is not."""
        return abs(self.measured - self.expected) <= self.tolerance

    def __str__(self) -> str:
        """One line."""
        bounds = f"{self.expected:.5g} ± {self.tolerance:.2g}"
        return f"{self.quantity}: {self.measured:.5g}, expected {bounds} {self.unit}".strip()


class Unstable(Exception):
    """The simulation blew up."""


class CheckFailed(AssertionError):
    """A measured value is out of tolerance.

    Attributes:
        comparison: The values.
    """

    def __init__(self, comparison: Comparison) -> None:
        """Takes the comparison that failed."""
        super().__init__(str(comparison))
        self.comparison = comparison


def steered(model: mujoco.MjModel) -> bool:
    """Whether a wheel is."""
    return has(model, "joint", "steering")


def rolling_wheels(model: mujoco.MjModel) -> list[str]:
    """All that turn on a joint: the driven two and those in front that do not merely slide."""
    return [*REAR, *(front for front in fronts(model) if has(model, "joint", front))]


Report = list[Comparison]
CheckFunction = Callable[[mujoco.MjModel, Robot], Report]


def compare(
    quantity: str, measured: float, expected: float, unit: str = "", *, relative: float = 0.0, absolute: float = 0.0
) -> Comparison:
    """A measured value beside an expected one, within `absolute` + `relative` · |expected|."""
    tolerance = absolute + relative * abs(expected)
    return Comparison(quantity, float(measured), float(expected), float(tolerance), unit)


def between(quantity: str, measured: float, low: float, high: float, unit: str = "") -> Comparison:
    """A measured value that has to lie between two."""
    return compare(quantity, measured, (low + high) / 2, unit, absolute=(high - low) / 2)


# Driving open loop


@dataclass(frozen=True)
class Log:
    """What happened, one sample per hold of the control and one at the start, (T, …)."""

    time: Array
    qpos: Array
    qvel: Array
    reading: Array

    def __getitem__(self, column: int) -> Array:
        """One column of the readings of `mrctl.physics.plant`."""
        return self.reading[:, column]


class Car:
    """A compiled model on its wheels, driven open loop.

    Attributes:
        model: The model.
        data: Its state.
    """

    def __init__(self, model: mujoco.MjModel, pose: ArrayLike = (0, 0, 0), twist: ArrayLike = (0, 0)) -> None:
        """Stands the robot at a posture `(3,)` in m, m, rad, rolling with a twist `(2,)` in m/s, rad/s."""
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:] = stand(model, np.asarray(pose, float), np.asarray(twist, float))
        self._inputs = inputs(model)
        self._address = addresses(model)
        mujoco.mj_forward(model, self.data)

    def control(self, control: ArrayLike) -> None:
        """Sets voltages left and right in V, steering angle in rad and rate in rad/s, `(4,)`."""
        self.data.ctrl[self._inputs] = np.asarray(control)[: len(self._inputs)]

    def drive(self, seconds: float, control: ArrayLike | Control, hold: float = HOLD) -> Log:
        """Drives for a time with a control, constant or a function of the time since the call, held for `hold`.

        Raises:
            Unstable: The state is no longer finite.
        """
        law = control if callable(control) else lambda _: control
        substeps = max(1, round(hold / self.model.opt.timestep))
        hold = substeps * self.model.opt.timestep  # in whole steps
        ticks = max(1, round(seconds / hold))
        qpos, qvel = np.empty((ticks + 1, self.model.nq)), np.empty((ticks + 1, self.model.nv))
        qpos[0], qvel[0] = self.data.qpos, self.data.qvel
        for k in range(ticks):
            self.control(law(k * hold))
            mujoco.mj_step(self.model, self.data, substeps)
            qpos[k + 1], qvel[k + 1] = self.data.qpos, self.data.qvel
        reading = np.zeros((ticks + 1, 11))
        read(qpos, qvel, self._address, reading)
        self.assert_sane()
        return Log(hold * np.arange(ticks + 1.0), qpos, qvel, reading)

    def assert_sane(self) -> None:
        """Refuses a state that is not finite, and one from which the engine has silently started again at rest.

        Raises:
            Unstable: Either.
        """
        if any(self.data.warning[w].number for w in BLOWN) or not np.isfinite(self.data.qvel).all():
            raise Unstable

    def tyre_forces(self) -> Array:
        """Forces of the ground on left wheel, right wheel and front in the world frame, `(3, 3)` in N."""
        mujoco.mj_forward(self.model, self.data)
        forces, force = np.zeros((3, 3)), np.zeros(6)
        row = {self.model.geom(name).id: k for k, name in enumerate(REAR)}
        row |= {self.model.geom(name).id: 2 for name in fronts(self.model)}
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            mujoco.mj_contactForce(self.model, self.data, i, force)
            for side, sign in ((0, -1), (1, 1)):  # the frame's first axis points from geom 0 to geom 1
                if (geom := int(contact.geom[side])) in row:
                    forces[row[geom]] += sign * contact.frame.reshape(3, 3).T @ force[:3]
        return forces


def _settled(robot: Robot) -> float:
    """A time after which e^−12 is left of a transient of equation (3), in s."""
    return 12 * max(robot.velocity_time_constant, robot.rotation_time_constant)


def _time_constant(log: Log, column: int, tau: float) -> float:
    """Time constant of an exponential that settles within the log, from its values near τ/2 and 2 τ.

    Not from the start: the tyres, springs of 10 ms, first have to take up their load.
    """
    first, last = (int(np.searchsorted(log.time, time)) for time in (tau / 2, 2 * tau))
    left = (log[column][-1] - log[column][last]) / (log[column][-1] - log[column][first])
    return -(log.time[last] - log.time[first]) / np.log(left) if left > 0 else np.nan


def _cruise(model: mujoco.MjModel, robot: Robot, left: float, right: float) -> tuple[Car, Log]:
    """Drives with constant voltages until the twist has settled, from about where it will: no spin, no rising nose."""
    v = robot.velocity_gain * max(0.0, (left + right) / 2 - _loss_volts(robot))
    car = Car(model, twist=(v, robot.rotation_gain * (right - left) / 2))
    return car, car.drive(_settled(robot), (left, right, 0, 0))


def _loss_volts(robot: Robot) -> float:
    """Voltage that overcomes all Coulomb losses while driving straight on, in V."""
    return (robot.drive_loss + robot.rolling_force * robot.wheel_radius / 2) / robot.motor_gain


def _holding_force(robot: Robot) -> float:
    """All Coulomb losses as a force on the robot, in N."""
    return 2 * robot.drive_loss / robot.wheel_radius + robot.rolling_force


def _brake(robot: Robot) -> float:
    """Force per speed of the two motors' back-EMF, in N·s/m."""
    return 2 * robot.motor_gain * robot.back_emf / robot.wheel_radius**2


# Variants of a model, which isolate one law


def _motors(model: mujoco.MjModel) -> list[int]:
    return [model.actuator(name).id for name in MOTORS]


def open_circuit(model: mujoco.MjModel) -> mujoco.MjModel:
    """Motors disconnected: no current, so neither torque nor braking; rotors and losses stay."""
    model = clone(model)
    model.actuator_gainprm[_motors(model), 1] = 1e-9
    return model


def on_skid(model: mujoco.MjModel) -> mujoco.MjModel:
    """The front tyre without friction, so that it follows wherever equation (3) sends it, and brakes nothing."""
    model = clone(model)
    for wheel in (model.geom(name).id for name in fronts(model)):
        model.pair_friction[(model.pair_geom1 == wheel) | (model.pair_geom2 == wheel)] = 1e-5
    return model


def crisp(model: mujoco.MjModel, robot: Robot, tau: float) -> mujoco.MjModel:
    """Contacts and time step as short, against a time constant and the wheel radius, as those of the default robot.

    Slip and the tyres' sinking in, in proportion to a contact's time constant and to its square, then weigh no more.
    """
    share = min(1.0, tau / 0.18, np.sqrt(robot.wheel_radius / 0.098))
    model = clone(model)
    model.opt.timestep *= share
    model.pair_solref[:, 0] *= share
    model.pair_solreffriction[:, 0] *= share
    return model


def skid_robot(robot: Robot) -> Robot:
    """The parameters of the robot `on_skid`: what its rear wheels lose by rolling is booked as gear loss."""
    rear = robot.rolling_force * (1 - robot.front_load) / 2 * robot.wheel_radius
    return robot.model_copy(
        update={"gear_loss": robot.gear_loss + rear, "rolling_coefficient": 0.0, "front_wheel_inertia": 0.0}
    )


def towing(model: mujoco.MjModel, damping: float) -> mujoco.MjModel:
    """A load with a pull of `damping` N·s/m hangs on P, and a rail keeps the robot from turning and moving sideways."""
    model = clone(model)
    dof = model.joint("chassis").dofadr[0]
    model.dof_damping[[dof, dof + 1, dof + 5]] = damping, 1e6, 1e6
    return model


def perturbed(model: mujoco.MjModel, perturbation: Perturbation) -> mujoco.MjModel:
    """A perturbed copy."""
    copy = clone(model)
    perturb(model, copy, perturbation)
    return copy


# Is it a robot?


def stance(model: mujoco.MjModel, robot: Robot) -> Report:
    """On level ground the robot stands level: radii and heights of the axles fit together.

    Tolerance 0.5°, more than tyres that sink in can do, less than a wrong radius does.
    """
    car = Car(model)
    car.drive(1.0, (0, 0, 0, 0))
    frame = car.data.body("chassis").xmat.reshape(3, 3)
    nose, side = np.degrees(np.arcsin(frame[2, :2]))
    return [
        compare("nose up", nose, 0.0, "°", absolute=0.5),
        compare("left side up", side, 0.0, "°", absolute=0.5),
    ]


def _to_its_limit(model: mujoco.MjModel, robot: Robot, along: tuple[float, float], limit: float, rate: float) -> Log:
    """Drives from rest to a limit at the limit on its rate, with the voltages of equation (3) within the supply."""
    hold = min(HOLD, limit / rate / 50)

    def law(t: float) -> tuple[float, ...]:
        volts = inverse_dynamics(np.array(along) * rate * (t + hold / 2), np.array(along) * rate, robot)
        left, right = np.clip(volts, -robot.supply, robot.supply)
        return left, right, 0.0, 0.0

    return Car(model).drive(limit / rate, law, hold)


def limits(model: mujoco.MjModel, robot: Robot) -> Report:
    """What the model declares as limits on V and V̇, motors, gear, supply and grip can do, and the fork can steer.

    Tolerance 10 %: the voltages are those of equation (3), and nothing corrects slip.
    """
    log = _to_its_limit(model, robot, (1, 0), robot.max_speed, robot.max_acceleration)
    return [
        compare("V at its limit", log[V][-1], robot.max_speed, "m/s", relative=0.1),
        between("largest steering angle", robot.steering_limit, 0.1, np.pi / 2, "rad"),
    ]


def turning_limits(model: mujoco.MjModel, robot: Robot) -> Report:
    """The same of θ̇ and θ̈, on the spot, the front tyre without friction."""
    log = _to_its_limit(on_skid(model), robot, (0, 1), robot.max_rotation, robot.max_rotation_acceleration)
    return [compare("θ̇ at its limit", log[OMEGA][-1], robot.max_rotation, "rad/s", relative=0.1)]


def motors(model: mujoco.MjModel, robot: Robot) -> Report:
    """Each motor, on its own shaft, is one that exists: no-load speed U/k_E and time constant J_m R_a/k².

    Hub motors turn at some 100 rpm, model racing motors at 50,000; from coreless to cheap, 0.5 to 200 ms. The inertia
    may also be written at the wheel's joint; without a gear it may be part of the wheel's.
    """
    report = []
    for motor, wheel in zip(MOTORS, REAR, strict=True):
        actuator = model.actuator(motor)
        gear, (resistance, constant) = actuator.gear[0], actuator.gainprm[:2]
        inertia = model.actuator_armature[actuator.id] + model.joint(wheel).armature[0] / gear**2
        volts = model.actuator_ctrlrange[model.actuator_ctrladr[actuator.id], 1]
        report += [
            between(f"no-load speed of {motor}", volts / constant * 30 / np.pi, 100, 60e3, "rpm"),
            between(f"time constant of {motor}", inertia * resistance / constant**2, 0.5e-3 * (gear > 3), 0.2, "s"),
        ]
    return report


def inertias(model: mujoco.MjModel, robot: Robot) -> Report:
    """Inertias are possible: a wheel's is at most that of a hoop, the robot's about the vertical fits its size."""
    report = []
    for name in rolling_wheels(model):
        body, radius = model.body(name), model.geom(name).size[0]
        spin = body.inertia.max()  # a disc's own axis
        report.append(between(f"inertia of {name} over m r²", spin / (body.mass[0] * radius**2), 0.01, 1))
    gyration = np.sqrt(robot.yaw_inertia / robot.mass)
    size = np.hypot(robot.wheelbase, robot.half_track)
    return report + [between("radius of gyration over the size", gyration / size, 0.05, 1.0)]


# At rest


def rest(model: mujoco.MjModel, robot: Robot) -> Report:
    """At rest the wheels bear the weight, split by the lever rule about the rear axle, and nothing moves.

    Front load m g c/(L − t): the contact trails the fork's axis. Tolerance 0.1 % of the weight: the tyres sink in by
    some 50 µm, which tilts the robot by 1e-4. Speed 1e-6 m/s: a contact is a critically damped spring of 10 ms, nothing
    pushes, and what is left is the last of the settling and the solver's tolerance.
    """
    car = Car(model)
    car.drive(2.0, (0, 0, 0, 0))
    log = car.drive(3.0, (0, 0, 0, 0))
    loads = car.tyre_forces()[:, 2]
    weight = robot.mass * GRAVITY
    rear = (1 - robot.front_load) / 2 * weight
    moved = np.abs(log.qpos[-1, :7] - log.qpos[0, :7]).max() / 3.0
    return [
        compare("sum of the wheel loads", loads.sum(), weight, "N", absolute=1e-3 * weight),
        compare("front load", loads[2], robot.front_load * weight, "N", absolute=1e-3 * weight),
        compare("left load", loads[0], rear, "N", absolute=1e-3 * weight),
        compare("right load", loads[1], rear, "N", absolute=1e-3 * weight),
        compare("drift at rest", moved, 0.0, "m/s", absolute=1e-6),
    ]


def hold_on_slope(model: mujoco.MjModel, robot: Robot) -> Report:
    """Shorted motors do not hold a robot on a slope, Coulomb friction does: up to m g sin α = 2 τ_loss/r + F_roll.

    At half of that slope it stands, but MuJoCo's friction is soft and creeps in proportion to its load: allowed is a
    tenth of the speed without friction. At twice, or less if tyres would slip, it rolls, and back-EMF brakes it to
    (m g sin α − losses)/B with B = 2 N² k²/(R_a r²). Tolerance 0.25 % of the force: slip and sinking tyres take 0.05 %
    each.
    """
    force, weight = _holding_force(robot), robot.mass * GRAVITY
    speeds, shares = [], (0.5, _steepest(robot))
    for share in shares:
        car = Car(perturbed(model, Perturbation(slope=-float(np.arcsin(share * force / weight)))))
        speeds.append(car.drive(_settled(robot), (0, 0, 0, 0))[V][-1])
    return [
        compare("creep at half the holding force", speeds[0], 0.0, "m/s", absolute=0.1 * force / 2 / _brake(robot)),
        compare(
            f"speed at {shares[1]:.3g} times the holding force",
            speeds[1],
            (shares[1] - 1) * force / _brake(robot),
            "m/s",
            absolute=2.5e-3 * shares[1] * force / _brake(robot),
        ),
    ]


def _steepest(robot: Robot) -> float:
    """Downhill force over the holding force, up to 2, at which half of the driven tyres' grip holds."""
    for share in np.linspace(2.0, 1.1, 10):
        sine = share * _holding_force(robot) / (robot.mass * GRAVITY)
        cosine, base = np.sqrt(max(0.0, 1 - sine**2)), robot.wheelbase - robot.trail
        front = (robot.com_offset * cosine + robot.com_height * sine) / base
        if sine < 0.5 * robot.tyre_friction * (cosine - front) and front > 0:
            return float(share)
    return 1.1


# Motors


def top_speed(model: mujoco.MjModel, robot: Robot) -> Report:
    """Driving straight on, V settles at r/(k_E N) · (U − U_loss), the losses being Coulomb friction.

    Two voltages separate the no-load speed r U/(k_E N) from U_loss. Tolerance of the gain 0.2 %: the tyres sink in by
    0.05 % of the radius; of the loss 1 %, because it is a small difference of large numbers.
    """
    high, low = robot.supply, robot.supply / 2
    fast, slow = (_cruise(model, robot, u, u)[1][V][-1] for u in (high, low))
    gain = (fast - slow) / (high - low)
    loss = high - fast / gain
    return [
        compare("no-load speed", gain * high, robot.velocity_gain * high, "m/s", relative=2e-3),
        compare("voltage lost to friction", loss, _loss_volts(robot), "V", relative=1e-2),
    ]


def stall(model: mujoco.MjModel, robot: Robot) -> Report:
    """The torque of a blocked wheel is N k_M U/R_a, and reaches the ground as P/r, P = N k_M U/R_a − τ_loss.

    Torque of the resting motor: exact but for rounding. Then the robot tows a load so heavy that it crawls at 5 % of
    its no-load speed (fully blocked, Coulomb friction would be undetermined), held in its heading: it pulls with
    (P_d + P_s)/r and twists with (D/r)(P_d − P_s). The front tyre carries no force, the rear ones half of their grip.
    Tolerance 0.5 %: the tyres sink in by 0.05 % of their radius and creep a little under load; measured 0.02 %.
    """
    car = Car(model)
    car.control((robot.supply, robot.supply, 0, 0))
    mujoco.mj_forward(model, car.data)
    shaft = [car.data.qfrc_actuator[model.joint(name).dofadr[0]] for name in REAR]
    report = [
        compare(f"stall torque {side}", torque, robot.motor_gain * robot.supply, "N·m", relative=1e-6)
        for side, torque in zip(("left", "right"), shaft, strict=True)
    ]
    skid = skid_robot(robot)
    grip = robot.tyre_friction * robot.mass * GRAVITY * (1 - robot.front_load) / 2
    right = min(robot.supply, grip / 2 * robot.wheel_radius / robot.motor_gain)
    left = 0.7 * right
    share = 0.95
    car = Car(towing(on_skid(model), share / (1 - share) * _brake(robot)))
    car.drive(2.0, (left, right, 0, 0))
    mujoco.mj_forward(car.model, car.data)
    dof = model.joint("chassis").dofadr[0]
    pull, _, twist = -car.data.qfrc_passive[[dof, dof + 1, dof + 5]]
    force = (robot.motor_gain * (right + left) - 2 * skid.drive_loss) / robot.wheel_radius
    couple = robot.half_track / robot.wheel_radius * robot.motor_gain * (right - left)
    return report + [
        compare("pull", pull, share * force, "N", relative=5e-3),
        compare("twist", twist, couple, "N·m", relative=5e-3),
    ]


def velocity_time_constant(model: mujoco.MjModel, robot: Robot) -> Report:
    """A step of U_Σ on a robot that already moves: gain r/(k_E N), time constant M_e r² R_a/(2 N² k²).

    Moving, the Coulomb losses are constant and drop out. Tolerance 0.5 %, well under the 1.9 % that the rotors
    contribute to M_e: at 2 ms the time step adds 0.1 %, and the tyres, which sink in and give, take 0.05 %.
    """
    volts = robot.supply / 3
    step = robot.supply / 24
    tau = robot.velocity_time_constant
    car, _ = _cruise(crisp(model, robot, tau), robot, volts, volts)
    log = car.drive(_settled(robot), (volts + step, volts + step, 0, 0), min(HOLD, tau / 10))
    gain = (log[V][-1] - log[V][0]) / step
    return [
        compare("gain of V", gain, robot.velocity_gain, "m/s/V", relative=5e-3),
        compare("time constant of V", _time_constant(log, V, tau), tau, "s", relative=5e-3),
    ]


def rotation_time_constant(model: mujoco.MjModel, robot: Robot) -> Report:
    """A small step of U_Δ while driving straight on: J_e θ̈ = 2 (D/r) (N k_M/R_a) U_Δ − (B + m c V) θ̇.

    B = 2 (D/r)² N² k²/R_a is the braking of both motors. Both wheels turn forwards, so the Coulomb losses are
    constant and drop out, and to first order V does not move. The front tyre carries no force, so that equation (3)
    holds as it stands. Tolerance 1 %, under the 1.6 % that the rotors contribute to J_e: the sideways give of the
    tyres takes 0.8 % (with contacts of 2 ms instead of 10 it takes 0.05 %), the time step of 2 ms adds 0.2 %.
    """
    skid = skid_robot(robot)
    common, step = robot.supply / 3, robot.supply / 240
    arm = robot.half_track / robot.wheel_radius
    v = robot.velocity_gain * (common - _loss_volts(skid))
    damping = 2 * arm**2 * robot.motor_gain * robot.back_emf + robot.mass * robot.com_offset * v
    tau = skid.effective_inertia / damping
    car, _ = _cruise(on_skid(crisp(model, robot, tau)), robot, common, common)
    log = car.drive(_settled(robot), (common - step, common + step, 0, 0), min(HOLD, tau / 10))
    gain = (log[OMEGA][-1] - log[OMEGA][0]) / step
    return [
        compare("gain of θ̇", gain, 2 * arm * robot.motor_gain / damping, "rad/s/V", relative=1e-2),
        compare("time constant of θ̇", _time_constant(log, OMEGA, tau), tau, "s", relative=1e-2),
    ]


def coast_down(model: mujoco.MjModel, robot: Robot) -> Report:
    """With the motors disconnected V falls at the constant rate (2 τ_loss/r + F_roll)/M_e.

    Tolerance 0.3 %: sinking tyres 0.05 %; the fit's residual shows that the rate is constant.
    """
    deceleration = _holding_force(robot) / robot.effective_mass
    speed = robot.max_speed
    log = Car(open_circuit(model), twist=(speed, 0)).drive(0.8 * speed / deceleration, (0, 0, 0, 0))
    moving = log.time > 0.1  # the tyres take up their load
    slope, start = np.polyfit(log.time[moving], log[V][moving], 1)
    bend = np.abs(log[V] - start - slope * log.time)[moving].max()
    return [
        compare("deceleration", -slope, deceleration, "m/s²", relative=3e-3),
        compare("departure from a straight line", bend, 0.0, "m/s", absolute=1e-3 * speed),
    ]


# Rolling


def _curvature(robot: Robot, angle: float) -> float:
    """That of the circle on which a front wheel at an angle rolls without scrub, sin φ/(L cos φ − t), in 1/m."""
    return np.sin(angle) / (robot.wheelbase * np.cos(angle) - robot.trail)


def _electronic_differential(robot: Robot, volts: float, angle: float, rate: float = 0.0) -> tuple[float, ...]:
    """Control that drives a rigidly steered robot without the rear wheels fighting the front one."""
    v = robot.velocity_gain * (volts - _loss_volts(robot))
    omega = v * _curvature(robot, angle)
    apart = robot.back_emf * robot.half_track * omega / robot.wheel_radius
    return volts - apart, volts + apart, angle, rate


def circle(model: mujoco.MjModel, robot: Robot) -> Report:
    """Rigidly steered, P goes round a circle of radius L/tan φ, with trail (L cos φ − t)/sin φ.

    Driven at a tenth of the tyres' grip. Tolerance 0.5 %: the tyres drift outwards (see `scrub_free`), which turns the
    robot on the circle but hardly changes the radius, and the servo gives; measured 0.03 %.
    """
    angle = 0.5 * robot.steering_limit
    radius = 1 / _curvature(robot, angle)
    v = np.sqrt(0.1 * robot.tyre_friction * GRAVITY * radius)
    volts = v / robot.velocity_gain + _loss_volts(robot)
    report = []
    for side, sign in (("left", 1), ("right", -1)):
        car = Car(model)
        car.drive(_settled(robot), _electronic_differential(robot, volts, sign * angle))
        log = car.drive(2 * np.pi * radius / v, _electronic_differential(robot, volts, sign * angle))
        x, y = log[X], log[Y]
        # (x − a)² + (y − b)² = R², linear in a, b and R² − a² − b².
        a, b, rest = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
        report.append(compare(f"radius {side}", np.sqrt(rest + a**2 + b**2), radius, "m", relative=5e-3))
        report.append(compare(f"sense {side}", np.sign(log[OMEGA]).mean(), sign, absolute=0))
    return report


def rolling(model: mujoco.MjModel, robot: Robot) -> Report:
    """Equation (1) along a winding run: front wheel rate and φ give V, θ̇, both rear wheel rates, and no sideways slip.

    Rigidly steered, no trail. Tolerances are shares of the mean speed (of V/L for θ̇): 1 %, mostly the sideways drift
    that `scrub_free` explains.
    """
    volts, w = robot.supply / 4, 2 * np.pi / 2.0

    def law(t: float) -> tuple[float, ...]:
        middle = t + HOLD / 2
        return _electronic_differential(robot, volts, 0.35 * np.sin(w * middle), 0.35 * w * np.cos(w * middle))

    car = Car(model)
    car.drive(_settled(robot), _electronic_differential(robot, volts, 0.0))
    log = car.drive(6.0, law)
    front = np.mean([log.qvel[:, model.joint(f).dofadr[0]] for f in fronts(model)], axis=0) * robot.front_wheel_radius
    twist = twist_from_front_wheel(front, log[STEERING], robot)
    rates = wheel_rates(twist, robot)
    rows = (
        ("V", log[V], twist[:, 0], 1.0, "m/s"),
        ("θ̇", log[OMEGA], twist[:, 1], robot.wheelbase, "rad/s"),
        ("left wheel rate", log[RATE_LEFT], rates[:, 0], robot.wheel_radius, "rad/s"),
        ("right wheel rate", log[RATE_RIGHT], rates[:, 1], robot.wheel_radius, "rad/s"),
        ("sideways speed", log[V_LATERAL], 0.0, 1.0, "m/s"),
    )
    speed = robot.velocity_gain * (volts - _loss_volts(robot))
    return [
        compare(
            f"{name}: departure from equation (1)", np.abs(seen - ideal).max(), 0.0, unit, absolute=0.01 * speed / arm
        )
        for name, seen, ideal, arm, unit in rows
    ]


# Tyres


def _spinning(model: mujoco.MjModel, robot: Robot, friction: float, x: float = 0.0) -> Report:
    """Full voltage from rest at x, where the rear tyres cannot take it.

    N_f (L − t) = m g c − m a h and (m + J_f/r_f²) a = μ (m g − N_f) − (front rolling loss), solved for a.
    Tolerance 2 %: see `traction`.
    """
    front = robot.front_load
    inert = robot.mass + robot.front_wheel_inertia / robot.front_wheel_radius**2
    inert -= friction * robot.mass * robot.com_height / (robot.wheelbase - robot.trail)
    expected = (friction * robot.mass * GRAVITY * (1 - front) - front * robot.rolling_force) / inert
    seconds = min(0.8, 0.5 * robot.velocity_gain * robot.supply / expected)  # faster, the wheels would catch up
    car = Car(crisp(model, robot, robot.velocity_time_constant), pose=(x, 0, 0))
    log = car.drive(seconds, (robot.supply, robot.supply, 0, 0), min(HOLD, seconds / 40))
    steady = log.time > seconds / 4  # the wheels have reached their speed
    acceleration = np.polyfit(log.time[steady], log[V][steady], 1)[0]
    slip = ((log[RATE_LEFT] + log[RATE_RIGHT]) / 2 * robot.wheel_radius - log[V])[steady].min()
    return [
        compare("acceleration while wheels spin", acceleration, expected, "m/s²", relative=2e-2),
        compare("the wheels spin (1: yes)", float(slip > 0.1 * robot.max_speed), 1.0),
    ]


def traction(model: mujoco.MjModel, robot: Robot) -> Report:
    """On a slippery floor full voltage spins the rear wheels, and μ times their load is all that accelerates.

    Their load includes the transfer m a h/(L − t), 6 % of the acceleration. Tolerance 2 %: MuJoCo's soft friction cone
    lifts a tyre that slides at 1 m/s by some 0.2 mm, where it hops, so that the acceleration has to be averaged.
    """
    slippery = perturbed(model, Perturbation(tyre_friction_factor=0.2))
    return _spinning(slippery, robot, 0.2 * robot.tyre_friction)


def cornering(model: mujoco.MjModel, robot: Robot) -> Report:
    """All tyres together bend the path with μ g at most: with half of that a robot keeps to its circle, with twice not.

    Rigidly steered on a slippery floor, launched on the circle. Tolerance of the radius 0.5 %, as in `circle`. Of the
    limit 3 %: sliding tyres hop, so the acceleration is averaged over 0.1 s, and its peak with it; measured 1.1 %
    short, over 0.04 s 0.3 %.
    """
    angle = 0.3
    limit = 0.2 * robot.tyre_friction * GRAVITY
    slippery = perturbed(model, Perturbation(tyre_friction_factor=0.2))
    radius = 1 / _curvature(robot, angle)
    logs = []
    for share in (0.5, 2.0):
        v = np.sqrt(share * limit * radius)
        volts = v / robot.velocity_gain + _loss_volts(robot)
        car = Car(slippery, twist=(v, v / radius))
        logs.append(car.drive(1.5, _electronic_differential(robot, volts, angle)))
    slow, fast = logs
    ahead = np.stack([np.cos(fast[THETA]), np.sin(fast[THETA])], axis=1)
    centre = fast.reading[:, [X, Y]] + robot.com_offset * ahead
    k = round(0.1 / fast.time[1])  # second difference over 0.1 s: no vibration
    bend = np.hypot(*(centre[2 * k :] - 2 * centre[k:-k] + centre[: -2 * k]).T) / fast.time[k] ** 2
    return [
        compare("radius below the limit", slow[V][-1] / slow[OMEGA][-1], radius, "m", relative=5e-3),
        compare("largest acceleration above it", bend.max(), limit, "m/s²", relative=3e-2),
        compare("it slides (1: yes)", float(np.abs(fast[V_LATERAL]).max() > 0.1 * fast[V][0]), 1.0),
    ]


# Equation (3)


def centre_of_mass(model: mujoco.MjModel, robot: Robot) -> Report:
    """An offset centre of mass pushes forward with m c θ̇² and resists turning with m c V θ̇.

    In a steady turn both are what the motors, known from voltages and speeds, do not explain otherwise:
    m c θ̇² = F_loss − (P_d + P_s)/r − m v θ̇ and m c V θ̇ = (D/r)(P_d − P_s), with v the sideways drift of the rear
    tyres (see `scrub_free`). The front tyre carries no force. Then a payload behind the axle leaves a tenth of c, and
    of both terms. Tolerance 2 % of the whole term: both are differences of voltage and back-EMF, which are ten times
    larger, and to which the tyres' sinking adds 0.05 %.
    """
    back, left = 0.5, 0.1  # m behind P, share of c that is left
    ballast = robot.mass * robot.com_offset * (1 - left) / (back + left * robot.com_offset)
    payload = Perturbation(payload=ballast, payload_x=-back, payload_z=robot.wheel_radius)
    update = {"mass": robot.mass + ballast, "com_offset": left * robot.com_offset}
    loss = skid_robot(robot).drive_loss / robot.motor_gain
    drive = np.array([0.1, 0.5]) * robot.supply - loss
    v, omega = robot.velocity_gain * drive.mean(), robot.rotation_gain * (drive[1] - drive[0]) / 2
    volts = loss + drive * min(1.0, np.sqrt(0.2 * robot.tyre_friction * GRAVITY / abs(v * omega)))
    report = []
    whole = robot.mass * robot.com_offset
    laden = perturbed(model, payload), robot.model_copy(update=update)
    for name, car, true in (("", model, robot), (" with c/10", *laden)):
        crispy = crisp(on_skid(car), true, min(true.velocity_time_constant, true.rotation_time_constant))
        start = Car(crispy, twist=(robot.velocity_gain * (volts.mean() - loss), 0))
        log = start.drive(2 * _settled(true), (*volts, 0, 0))
        v, omega, sideways = log.reading[-1, [V, OMEGA, V_LATERAL]]
        torques = true.motor_gain * (volts - true.back_emf * wheel_rates((v, omega), true))
        loss = 2 * skid_robot(true).drive_loss
        push = (loss - torques.sum()) / true.wheel_radius - true.mass * sideways * omega
        drag = true.half_track / true.wheel_radius * (torques[1] - torques[0])
        lever = true.mass * true.com_offset
        report += [
            compare(f"m c θ̇²{name}", push, lever * omega**2, "N", absolute=0.02 * whole * omega**2),
            compare(f"m c V θ̇{name}", drag, lever * v * omega, "N·m", absolute=0.02 * whole * v * omega),
        ]
    return report


def prediction(model: mujoco.MjModel, robot: Robot) -> Report:
    """Equation (3), corrected, predicts V and θ̇ of a caster-steered robot from its voltages alone.

    Both voltages wind through 20 s with periods of 2 to 7 s, from about the speed that they hold; the law is integrated
    by Runge and Kutta's method. Tolerances are shares of the root mean squares: 1 % of V, 6 % of θ̇, to which the
    real fork, with the mass, damping and rolling loss of its wheel, adds what the equation leaves out.
    """

    def law(t: float) -> tuple[float, ...]:
        common = robot.supply * (0.35 + 0.08 * np.sin(0.9 * t) + 0.05 * np.sin(2.3 * t))
        apart = robot.supply * (0.05 * np.sin(1.3 * t) + 0.04 * np.sin(3.1 * t))
        return common - apart, common + apart, 0.0, 0.0

    rolling = robot.velocity_gain * (0.35 * robot.supply - _loss_volts(robot)), 0.0
    log = Car(model, twist=rolling).drive(20.0, law)
    twist = np.zeros((len(log.time), 2))
    twist[0] = rolling
    for k, t in enumerate(log.time[:-1]):
        volts = law(t)[:2]
        s, h = twist[k], log.time[1]
        k1 = accelerations(s, volts, robot)
        k2 = accelerations(s + h / 2 * k1, volts, robot)
        k3 = accelerations(s + h / 2 * k2, volts, robot)
        k4 = accelerations(s + h * k3, volts, robot)
        twist[k + 1] = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    error = np.sqrt(np.mean((twist - log.reading[:, [V, OMEGA]]) ** 2, axis=0) / np.mean(twist**2, axis=0))
    return [
        compare("error of V", error[0], 0.0, absolute=1e-2),
        compare("error of θ̇", error[1], 0.0, absolute=6e-2),
    ]


# Caster


def scrub_free(model: mujoco.MjModel, robot: Robot) -> Report:
    """A fork without stiffness takes the angle at which its wheel rolls without scrub.

    In a steady turn φ = atan(L θ̇/V) − asin(t θ̇/√(V² + L² θ̇²)), in a changing one
    sin(direction − φ) = t (θ̇ + φ̇)/speed, with direction and speed of the fork's axis. Steady 5 mrad; measured 0.03,
    as P and the fork drift alike. Changing, a sideslip of 7 ms · θ̇: MuJoCo's contacts (time constant T, impedance d)
    damp the slip velocity but do not know that its frame turns, so a tyre drifts outwards with V θ̇ d T/2 whatever its
    friction, here d T/2 = 4.75 ms.
    """
    common, apart = robot.supply / 3, robot.supply / 12
    car = Car(model)
    log = car.drive(_settled(robot) + 2.0, (common - apart, common + apart, 0, 0))
    steady = float(scrub_free_angle(log.reading[-1, [V, OMEGA]], robot))
    report = [compare("angle in a steady turn", log[STEERING][-1], steady, "rad", absolute=5e-3)]

    def law(t: float) -> tuple[float, ...]:
        swing = apart * np.cos(2.0 * t)
        return common - swing, common + swing, 0.0, 0.0

    log = car.drive(8.0, law)
    rate = log.qvel[:, model.joint("steering").dofadr[0]]
    side = robot.wheelbase * log[OMEGA] + log[V_LATERAL]
    seen = np.sin(np.arctan2(side, log[V]) - log[STEERING])
    ideal = robot.trail * (log[OMEGA] + rate) / np.hypot(log[V], side)
    drift = 7e-3 * np.abs(log[OMEGA]).max()
    return report + [compare("scrub in a changing turn", np.abs(seen - ideal).max(), 0.0, "rad", absolute=drift)]


# Energy, symmetry, time step


def _winding(robot: Robot) -> Callable[[float], tuple[float, ...]]:
    """A control that speeds up and slows down, turns both ways and steers as it turns."""
    lock = min(0.3, 0.6 * robot.steering_limit)
    grip = np.sqrt(0.1 * robot.tyre_friction * GRAVITY * abs(robot.wheelbase) / np.tan(lock))  # at a tenth of it
    volts = min(0.4 * robot.supply, grip / robot.velocity_gain + _loss_volts(robot))

    def law(t: float) -> tuple[float, ...]:
        common = volts * (1 + 0.25 * np.sin(2.0 * t))
        apart = volts * 0.15 * np.sin(1.7 * t)
        return common - apart, common + apart, lock * np.sin(1.7 * t - 0.5), 1.7 * lock * np.cos(1.7 * t - 0.5)

    return law


def _energy_balance(model: mujoco.MjModel, robot: Robot, seconds: float) -> tuple[float, float]:
    """Drives a winding run; returns what is missing in the energy balance and what came from the supply, in J.

    From the supply: U I, with the current of the nominal motor, of which R_a I² is heat. To the floor and the bearings:
    tyre slip from the contact forces, what linkages and bearings of the steering take, and the nominal Coulomb torques.
    The rest is MuJoCo's mechanical energy.
    """
    model = clone(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    car, law = Car(model), _winding(robot)
    data = car.data
    dofs = np.array([model.joint(name).dofadr[0] for name in rolling_wheels(model)])
    forks = [dof for dof in range(6, model.nv) if dof not in dofs]
    servos = [model.joint("steering").dofadr[0]] if steered(model) else []
    rear = robot.drive_loss + robot.rolling_force * (1 - robot.front_load) / 2 * robot.wheel_radius
    front = robot.rolling_force * robot.front_load * robot.front_wheel_radius
    coulomb = np.array([rear, rear, *([front / max(1, len(dofs) - 2)] * (len(dofs) - 2))])
    h, substeps = model.opt.timestep, max(1, round(HOLD / model.opt.timestep))
    before = data.energy.sum()
    supplied = balance = 0.0
    for k in range(round(seconds / (h * substeps))):
        control = np.asarray(law(k * h * substeps))
        car.control(control)
        for _ in range(substeps):
            velocity = data.qvel.copy()
            mujoco.mj_step(model, data)
            velocity = (velocity + data.qvel) / 2  # force times this is the work of a step, exactly
            current = (control[:2] - robot.back_emf * velocity[dofs[:2]]) / robot.resistance
            rows = np.zeros(data.nefc)
            mujoco.mj_mulJacVec(model, data, rows, velocity)
            coulombs = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
            slip = (
                -(data.efc_force * rows)[data.efc_type != coulombs].sum() - data.qfrc_passive[forks] @ velocity[forks]
            )
            servo = data.qfrc_actuator[servos] @ velocity[servos]
            supplied += h * control[:2] @ current
            balance += h * (control[:2] @ current - robot.resistance * current @ current - slip + servo)
            balance -= h * coulomb @ np.abs(velocity[dofs])
    mujoco.mj_forward(model, data)
    car.assert_sane()
    return balance - (data.energy.sum() - before), supplied


def energy(model: mujoco.MjModel, robot: Robot) -> Report:
    """Electrical energy in = heat of the windings + tyre slip + Coulomb friction + mechanical energy.

    Tolerance 2 %, far above the 0.1 % measured at 2 ms. What is missing shrinks with the time step, by half as the step
    is halved (the integrator is of first order); 0.2 for the start from rest, which jumps between steps.
    """
    report, missing = [], []
    for halvings in range(3):
        fine = clone(model)
        fine.opt.timestep /= 2**halvings
        lost, supplied = _energy_balance(fine, robot, 2.0)
        missing.append(abs(lost))
        step = f"{1e3 * fine.opt.timestep:g} ms"
        report.append(compare(f"missing share at {step}", lost / supplied, 0.0, absolute=0.02))
    return report + [
        compare("missing at half the time step", missing[1] / missing[0], 0.5, absolute=0.2),
        compare("missing at a quarter, to that at half", missing[2] / missing[1], 0.5, absolute=0.2),
    ]


def mirror(model: mujoco.MjModel, robot: Robot) -> Report:
    """With left and right exchanged the robot drives the mirrored path.

    Tolerance 1e-9 m and rad after 4 s: rounding, as sums run in another order; no motion here amplifies it.
    """
    law = _winding(robot)
    other = Car(model).drive(4.0, lambda t: np.array(law(t))[[1, 0, 2, 3]] * (1, 1, -1, -1))
    log = Car(model).drive(4.0, law)
    gap = log.reading[:, [X, Y, THETA]] - other.reading[:, [X, Y, THETA]] * (1, -1, -1)
    return [compare("departure from the mirrored path", np.abs(gap).max(), 0.0, "m, rad", absolute=1e-9)]


def invariance(model: mujoco.MjModel, robot: Robot) -> Report:
    """From another place and heading the robot drives the same path, moved and turned.

    Tolerance 1e-9 m after 4 s, as for `mirror`.
    """
    law, (x, y, theta) = _winding(robot), (0.7, -0.4, 1.1)
    log = Car(model).drive(4.0, law)
    other = Car(model, pose=(x, y, theta)).drive(4.0, law)
    c, s = np.cos(theta), np.sin(theta)
    moved = log.reading[:, [X, Y]] @ np.array([[c, s], [-s, c]]) + (x, y)
    gap = np.abs(moved - other.reading[:, [X, Y]]).max()
    return [compare("departure from the moved path", gap, 0.0, "m", absolute=1e-9)]


def convergence(model: mujoco.MjModel, robot: Robot) -> Report:
    """The path converges with the time step, at first order: halving the step halves the change of the end point.

    `implicitfast` is a first order method, so the ratio of changes is 1/2 but for the next term; measured 0.4998. Stiff
    servos and linkages come to it at shorter steps: 0.15.
    Started rolling, because the instant at which Coulomb friction lets go jumps from step to step. The first change,
    also the error that is left at 1 ms, is below 0.5 mm per metre driven.
    """
    ends, path = [], 0.0
    law = _winding(robot)
    speed = 5 / 6 * robot.velocity_gain * law(0.0)[0]  # less than it will be, so that a fast motor shows
    for halvings in range(4):
        fine = clone(model)
        fine.opt.timestep /= 2**halvings
        log = Car(fine, twist=(speed, 0)).drive(4.0, law)
        ends.append(log.reading[-1, [X, Y]])
        path = np.abs(log[V]).mean() * log.time[-1]
    changes = np.hypot(*np.diff(ends, axis=0).T)
    return [
        compare("second change of the end point over the first", changes[1] / changes[0], 0.5, absolute=0.15),
        compare("third over the second", changes[2] / changes[1], 0.5, absolute=0.15),
        compare("change as the time step is halved", changes[0], 0.0, "m", absolute=5e-4 * path),
    ]


# The shipped worlds


def slope(model: mujoco.MjModel, robot: Robot) -> Report:
    """On the 10° slope a robot with its motors disconnected rolls down with (m g sin 10° − losses)/M_e.

    Tolerance 0.3 %, as in `coast_down`; Coulomb losses do not know that the load is 1.5 % smaller.
    """
    expected = (robot.mass * GRAVITY * np.sin(np.radians(10)) - _holding_force(robot)) / robot.effective_mass
    log = Car(open_circuit(model)).drive(1.0, (0, 0, 0, 0))
    moving = log.time > 0.2
    measured = -np.polyfit(log.time[moving], log[V][moving], 1)[0]
    return [compare("acceleration downhill", measured, expected, "m/s²", relative=3e-3)]


def tilted_gravity(model: mujoco.MjModel, robot: Robot) -> Report:
    """`Perturbation.slope`, gravity seen in the slope's own frame, moves the robot as the tilted plane does.

    Both start 1 µm deep in the ground: touching it to within rounding, one of them would fall for a step. Tolerance
    1e-5 m on a path of 1.5 m: measured 1e-7, as the world file rounds its angle to 3e-8 rad.
    """
    level = clone(model)
    level.geom_quat[level.geom("floor").id] = 1, 0, 0, 0
    level = perturbed(level, Perturbation(slope=float(np.radians(10))))
    logs = []
    for car in (Car(model), Car(level)):
        frame = car.data.geom("floor").xmat.reshape(3, 3)
        car.data.qpos[:3] -= 1e-6 * frame[:, 2]
        log = car.drive(3.0, _winding(robot))
        logs.append((log.qpos[:, :3] - log.qpos[0, :3]) @ frame)  # in the axes of the ground
    gap = np.abs(logs[0] - logs[1]).max()
    return [compare("departure from the real slope", gap, 0.0, "m", absolute=1e-5)]


def patch(model: mujoco.MjModel, robot: Robot) -> Report:
    """On the icy patch, μ = 0.1, full voltage spins the wheels; tolerance and law of `traction`."""
    return _spinning(model, robot, 0.1, x=0.85)


def rough(model: mujoco.MjModel, robot: Robot) -> Report:
    """On the rough ground the robot keeps going and tilts no more than its bumps can make it.

    Bumps of 3 cm under one end of wheelbase and track: at most atan √((3/37)² + (3/38)²) ≈ 6.5°. Speed: that of level
    ground, as ups and downs cancel; 5 %, for tyres that slip and a path longer than its shadow.
    """
    bump = 0.03
    volts = robot.supply / 3
    log = Car(model, pose=(-4, 0, 0)).drive(8.0, (volts, volts, 0, 0))
    tilt = np.arccos(log[UPRIGHT].min())
    most = np.arctan(np.hypot(bump / (robot.wheelbase - robot.trail), bump / (2 * robot.half_track)))
    moving = log.time > 1.0
    v = robot.velocity_gain * (volts - _loss_volts(robot))
    return [
        compare("largest tilt", tilt, most / 2, "rad", absolute=most / 2),
        compare("mean speed", log[V][moving].mean(), v, "m/s", relative=5e-2),
    ]


class Check(NamedTuple):
    """A check with the world and the steering arrangement that it is for, and what kind of front it needs, if any."""

    function: CheckFunction
    world: str
    steering: Steering
    front: Literal["any", "steered", "without trail", "following", "trailing fork"] = "any"

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", str(self.function))

    def unsuited(self, model: mujoco.MjModel) -> str:
        """Why the check is not for a robot; empty if it is."""
        if self.front in ("steered", "without trail") and not steered(model):
            return "nothing is steered"
        if self.front == "without trail" and read_robot(model).trail > 1e-6:
            return "the steered wheel trails its axis, which equation (1) does not know"
        if self.front == "following" and steerings(model) == ("rigid",):
            return "servos hold the front wheels, which then leave the motors one degree of freedom"
        if self.front == "trailing fork" and "compliant" not in steerings(model):
            return "no trailing fork"
        return ""

    def measure(self, model: mujoco.MjModel, robot: Robot) -> Report:
        """All values, passed or not."""
        try:
            with np.errstate(all="ignore"):  # a ratio of nothing is no number, and no number passes
                return self.function(model, robot)
        except (Unstable, np.linalg.LinAlgError):
            return [compare("the simulation stays finite (1: yes)", 0.0, 1.0)]

    def run(self, model: mujoco.MjModel, robot: Robot) -> Report:
        """All values.

        Raises:
            CheckFailed: The first that is out of tolerance.
        """
        report = self.measure(model, robot)
        for comparison in report:
            if not comparison.passed:
                raise CheckFailed(comparison)
        return report


CHECKS = (
    Check(stance, "flat", "compliant"),
    Check(limits, "flat", "compliant"),
    Check(turning_limits, "flat", "rigid"),
    Check(motors, "flat", "compliant"),
    Check(inertias, "flat", "compliant"),
    Check(rest, "flat", "compliant"),
    Check(hold_on_slope, "flat", "compliant"),
    Check(top_speed, "flat", "compliant"),
    Check(stall, "flat", "rigid"),
    Check(velocity_time_constant, "flat", "compliant"),
    Check(rotation_time_constant, "flat", "rigid"),
    Check(coast_down, "flat", "compliant"),
    Check(circle, "flat", "rigid", "steered"),
    Check(rolling, "flat", "rigid", "without trail"),
    Check(traction, "flat", "compliant"),
    Check(cornering, "flat", "rigid", "steered"),
    Check(centre_of_mass, "flat", "rigid"),
    Check(prediction, "flat", "caster", "following"),
    Check(scrub_free, "flat", "caster", "trailing fork"),
    Check(energy, "flat", "compliant"),
    Check(mirror, "flat", "compliant"),
    Check(invariance, "flat", "compliant"),
    Check(convergence, "flat", "compliant"),
    Check(slope, "slope", "compliant"),
    Check(tilted_gravity, "slope", "compliant"),
    Check(patch, "patch", "compliant"),
    Check(rough, "rough", "compliant"),
)
"""All checks. Those of the world `flat` suit any robot on a level floor, the others need the shipped worlds."""
