"""Allocation: the fork against the kinematics of its contact, the voltages against the dynamics and the supply."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mrctl.control.nominal import nominal
from mrctl.control.steering import ALLOCATION, HOLD_SPEED, allocate, steer, take_loss
from mrctl.kernel import over_rows
from mrctl.theory import kinematics
from mrctl.theory.dynamics import common_differential, inverse_dynamics, left_right
from mrctl.theory.references import Lemniscate, StopAndGo

ZERO = np.zeros(2)


@pytest.fixture(scope="module")
def stiff(robot):
    """The robot as `rigid` steering knows it: no trail."""
    return robot.model_copy(update={"trail": 0.0})


class Allocation:
    """The allocation of one robot; its attributes are the fields of the record `ALLOCATION`."""

    def __init__(self, robot, rigid=False, period=0.01, angle=0.0):
        self._robot, self._period = nominal(robot, rigid)[0], period
        self._record = np.zeros(1, ALLOCATION)
        self._record["angle"] = angle

    def __getattr__(self, name):
        return self._record[name][0]

    def __call__(self, twist, acceleration=ZERO, feedback=ZERO, feedforward=ZERO):
        twist, acceleration, *added = (np.asarray(a, float) for a in (twist, acceleration, feedback, feedforward))
        steer(twist, acceleration, *added, self._period, self._robot, self._record[0])
        allocate(twist, *added, self._period, self._robot, self._record[0])
        return self.command

    @property
    def parts(self):
        """Shares of the feedback in the voltages left and right, then those of the feedforward, `(4,)`."""
        return np.append(self.feedback, self.feedforward)


def fork(robot, motion, rigid=False, period=0.01):
    """Angle and rate (T,) along a reference."""
    allocation = Allocation(robot, rigid, period)
    found = []
    for twist, acceleration in zip(motion.twist, motion.acceleration, strict=True):
        allocation(twist, acceleration)
        found.append([allocation.angle, allocation.rate])
    return np.transpose(found)


def numbers(shape, bound):
    return arrays(float, shape, elements=st.floats(-bound, bound))


@settings(max_examples=30)  # of 6 s each
@given(st.floats(0.1, 1.5), st.floats(-3, 3))
def test_steady_turn(robot, v, omega):
    """In a steady turn the fork settles where its wheel rolls without scrub."""
    expected = kinematics.scrub_free_angle([v, omega], robot)
    assume(abs(expected) < robot.steering_limit)
    allocation = Allocation(robot)
    for _ in range(600):
        angle, rate = allocation([v, omega])[2:]
    assert angle == pytest.approx(expected, abs=1e-9)
    assert rate == 0


@pytest.mark.parametrize(("trail", "tolerance"), [(0.0, 0.002), (0.03, 0.02)])
def test_rate(robot, trail, tolerance):
    """The rate set-point is the angle's derivative, and leads it to mid-period."""
    h = 1e-3
    angle, rate = fork(robot.model_copy(update={"trail": trail}), Lemniscate().sample(h * np.arange(6000)), period=h)
    slope = (angle[2:] - angle[:-2]) / (2 * h)
    np.testing.assert_allclose(rate[1000:-1], slope[999:], atol=tolerance * np.abs(slope[999:]).max())
    allocation = Allocation(robot, period=0.01, angle=0.1)
    command = allocation([0.5, 0.4], [0.3, 0.8])
    np.testing.assert_allclose(command[2], allocation.angle + 0.005 * command[3], atol=1e-15)
    assert command[3] != 0


@pytest.mark.parametrize("period", [0.02, 0.05, 0.1])
def test_rate_as_a_robot_leaves_rest(robot, period):
    """The rate of the fork, as the curvature grows from rest on, is that of fine steps with any control period.

    The lag t/speed then shrinks by a large factor from one period to the next.
    """

    def rates(step):
        allocation, found = Allocation(robot, period=step), []
        for tick in range(round(1.0 / step)):
            v, v_dot = 1.5 * step * (tick + 1), 1.5
            omega = 0.5 * np.sin(3 * v) * v
            allocation([v, omega], [v_dot, (0.5 * np.sin(3 * v) + 1.5 * np.cos(3 * v) * v) * v_dot])
            found.append(allocation.rate)
        return np.array(found)

    exact = rates(period / 200)[199::200]
    np.testing.assert_allclose(rates(period), exact, atol=0.25 * np.abs(exact).max())


def test_contact_rolls(robot):
    """Along a lemniscate the swinging contact is not dragged sideways: sin(direction − φ)·speed = t (θ̇ + φ̇)."""
    h = 1e-3
    motion = Lemniscate().sample(h * np.arange(12000))
    v, omega = motion.twist.T

    def drag(angle):
        direction, speed = np.arctan2(robot.wheelbase * omega, v), np.hypot(v, robot.wheelbase * omega)
        lateral = speed * np.sin(direction - angle) - robot.trail * (omega + np.gradient(angle, h))
        return np.abs(lateral[1000:]).max()

    angle, _ = fork(robot, motion, period=h)
    assert drag(angle) < 1e-3
    assert drag(kinematics.scrub_free_angle(motion.twist, robot)) > 20 * drag(angle)  # the lag is what does it


def test_trail_in_reverse(robot):
    """In reverse a contact that does not scrub makes θ̇ as (1 − s t/speed)/(1 + s t/speed), forwards as commanded."""
    h, w = 1e-3, 20.0
    omega, last = 0.01 * np.sin(w * h * np.arange(3142)), slice(-943, -1)  # ten periods, of which three are looked at
    trailing = robot.model_copy(update={"trail": 0.02})
    for v, expected in ((0.3, 1.0), (-0.3, (1 - 1j * w * 0.02 / 0.3) / (1 + 1j * w * 0.02 / 0.3))):
        allocation, angle = Allocation(trailing, rigid=True, period=h), np.empty_like(omega)
        for k, (turn, rate) in enumerate(zip(omega, np.gradient(omega, h), strict=True)):
            allocation([v, turn], [0.0, rate])
            angle[k] = allocation.angle
        swing = trailing.trail * np.gradient(angle, h)
        made = (v * np.sin(angle) + swing) / (trailing.wheelbase * np.cos(angle) - trailing.trail)
        wave = np.exp(-1j * w * h * np.arange(len(omega)))[last]
        assert (made[last] @ wave) / (omega[last] @ wave) == pytest.approx(expected, abs=0.02)


@given(numbers(2, 3.0), numbers(2, 5.0))
def test_rigid(stiff, twist, acceleration):
    """Without trail the angle is atan(L θ̇/V) at once, forwards and in reverse, and its rate the derivative."""
    v, omega = twist
    angle = kinematics.steering_angle(twist, stiff)
    assume(np.hypot(v, 0.4 * omega) > 2 * HOLD_SPEED and abs(angle) < stiff.steering_limit - 1e-3)
    allocation = Allocation(stiff, rigid=True, angle=0.7)
    _, _, command, rate = allocation(twist, acceleration)
    h = 1e-6
    ahead, behind = (kinematics.steering_angle(twist + s * h * acceleration, stiff) for s in (1, -1))
    assert allocation.angle == pytest.approx(angle, abs=1e-12)
    assert rate == pytest.approx((ahead - behind) / (2 * h), rel=1e-3, abs=1e-5)
    assert command == pytest.approx(angle + 0.005 * rate, abs=1e-12)


def test_stop_and_go(stiff):
    """Through rest and reverse of a straight line the wheel stays straight."""
    angle, rate = fork(stiff, StopAndGo().sample(0.01 * np.arange(800)), rigid=True)
    assert not angle.any()
    assert not rate.any()


@pytest.mark.parametrize("rigid", [False, True])
@given(twist=numbers(2, 0.9 * HOLD_SPEED), acceleration=numbers(2, 3.0), angle=st.floats(-1, 1))
def test_rest(robot, rigid, twist, acceleration, angle):
    """At rest the fork holds its angle."""
    command = Allocation(robot, rigid, angle=angle)(twist, acceleration)
    assert command[2:].tolist() == [angle, 0]


@given(twist=numbers(2, 0.9 * HOLD_SPEED), feedback=numbers(2, 1.0), feedforward=numbers(2, 1.0))
def test_rest_of_rigid_steering(stiff, twist, feedback, feedforward):
    """A fork that is held makes the θ̇ of its angle; the rest of what was asked is excess, which unwinds an integral."""
    allocation = Allocation(stiff, rigid=True, angle=0.3)
    allocation(twist, feedback=feedback, feedforward=feedforward)
    made = twist[0] * np.tan(0.3) / stiff.wheelbase
    assert allocation.excess[1] == pytest.approx(made - twist[1] - feedback[1] - feedforward[1], abs=1e-12)
    assert allocation.saturated == (allocation.excess[1] != 0)


@pytest.mark.parametrize("rigid", [False, True])
@given(twist=numbers((8, 2), 3.0), acceleration=numbers((8, 2), 6.0), feedback=numbers((8, 2), 9.0))
def test_steering_limit(robot, stiff, rigid, twist, acceleration, feedback):
    """The fork stays within its stops (but for the half period that the set-point leads)."""
    allocation = Allocation(stiff if rigid else robot, rigid)
    for arguments in zip(twist, acceleration, feedback, strict=True):
        allocation(*arguments)
        assert abs(allocation.angle) <= robot.steering_limit


@pytest.mark.parametrize("stiffness", [0.0, 20.0])
@given(numbers(2, 40.0), numbers(2, 40.0), numbers(2, 1.0))
def test_voltages(robot, stiffness, feedback, feedforward, twist):
    """U_r,l = U_Σ ± U_Δ within the supply; excess is what that takes.

    Without a servo both shrink by the same factor where one is above the supply; with one, each is cut by itself.
    """
    allocation = Allocation(robot.model_copy(update={"steering_stiffness": stiffness}))
    voltage = allocation(twist, feedback=feedback, feedforward=feedforward)[:2]
    asked = left_right(feedback + feedforward)
    shrunk = asked * min(1.0, 24 / np.abs(asked).max(initial=1e-300))
    np.testing.assert_allclose(voltage, np.clip(asked, -24, 24) if stiffness else shrunk, atol=1e-12)
    assert np.abs(voltage).max() <= 24
    np.testing.assert_allclose(allocation.parts, [*left_right(feedback), *left_right(feedforward)], atol=1e-12)
    np.testing.assert_allclose(allocation.excess, common_differential(voltage - asked), atol=1e-12)
    assert allocation.saturated == (np.abs(allocation.parts[:2] + allocation.parts[2:]) > 24).any()


@given(numbers(2, 40.0), numbers(2, 1.0), numbers(2, 40.0), numbers(2, 1.0))
def test_rigid_voltages(stiff, feedback, correction, feedforward, twist):
    """With rigid steering the model makes the differential: k_E N D θ̇/r and half the difference of the drive losses."""
    feedback[1], feedforward[1] = 0.1 * correction
    allocation = Allocation(stiff, rigid=True)
    voltage = allocation(twist, feedback=feedback, feedforward=feedforward)[:2]
    # A robot that neither rolls with losses nor has its mass off P needs just these to turn steadily.
    light = stiff.model_copy(update={"rolling_coefficient": 0.0, "com_offset": 0.0})
    differential = common_differential(inverse_dynamics(twist, ZERO, light, 0.05))[1]
    expected = [feedback[0]] * 2 + [feedforward[0] - differential, feedforward[0] + differential]
    np.testing.assert_allclose(allocation.parts, expected, atol=1e-9)
    asked = allocation.parts[:2] + allocation.parts[2:]
    np.testing.assert_allclose(voltage, np.clip(asked, -24, 24), atol=1e-12)
    assert allocation.excess[0] == pytest.approx((voltage - asked).mean(), abs=1e-12)
    held = abs(allocation.angle) == stiff.steering_limit or (abs(twist[0]) <= HOLD_SPEED and allocation.excess[1] != 0)
    assert allocation.saturated == ((np.abs(asked) > 24).any() or held)


def test_rigid_correction(stiff):
    """Feedback and feedforward of the second channel act through the angle; what the stop cut of them is excess."""
    allocation = Allocation(stiff, rigid=True)
    allocation([0.5, 0.4], feedback=[0, 0.1], feedforward=[0, -0.03])
    assert kinematics.twist_from_front_wheel(0.5 / np.cos(allocation.angle), allocation.angle, stiff)[
        1
    ] == pytest.approx(0.47)
    assert allocation.excess[1] == allocation.saturated == 0
    for v in (0.3, -0.3):
        allocation([v, 1.0], feedback=[0, 0.8], feedforward=[0, 0.1])
        made = v * np.tan(allocation.angle) / 0.4  # θ̇ of the wheel at its stop
        assert abs(allocation.angle) == stiff.steering_limit
        assert allocation.excess[1] == pytest.approx(made - 1.9)
        assert allocation.saturated == 1


@given(st.floats(0.1, 1.5), st.sampled_from([-1, 1]), st.floats(0.001, 0.05))
def test_stop_with_trail(robot, v, side, trail):
    """At its stop a trailing wheel makes the θ̇ of the circle on which its contact is not dragged sideways."""
    trailing = robot.model_copy(update={"trail": trail})
    allocation = Allocation(trailing, rigid=True, angle=side * robot.steering_limit)
    allocation([v, 20.0 * side])
    assert allocation.angle == side * robot.steering_limit
    made = 20.0 * side + allocation.excess[1]
    contact = robot.wheelbase - trail * np.exp(1j * allocation.angle)
    velocity = (v + 1j * made * contact) * np.exp(-1j * allocation.angle)
    assert velocity.imag == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.filterwarnings("ignore:invalid value")
@given(
    twist=numbers((4, 2), 2.0), acceleration=numbers((4, 2), 5.0), feedback=numbers((4, 2), 30.0),
    feedforward=numbers((4, 2), 30.0), state=numbers((4, 2), 1.0),
)  # fmt: skip
def test_rows(robot, rigid, twist, acceleration, feedback, feedforward, state):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""

    def answer(rows, lost=()):
        inputs = [a[rows].copy() for a in (twist, acceleration, feedback, feedforward)]
        inputs[0][list(lost)] = inputs[2][list(lost)] = np.nan
        s = np.zeros(len(inputs[0]), ALLOCATION)
        s["angle"], s["rate"] = state[rows].T
        over_rows(steer, *inputs, 0.01, nominal(robot, rigid)[0], s)
        over_rows(allocate, inputs[0], *inputs[2:], 0.01, nominal(robot, rigid)[0], s)
        return s

    together = answer(slice(None), lost=[3])
    for i in (0, 1, 2):
        assert together[i].tobytes() == answer(slice(i, i + 1))[0].tobytes()


def test_loss_of_a_driver(robot):
    """What a current limit took is excess of the two channels, on top of that of the supply, and saturates."""
    for rigid in (False, True):
        allocation = Allocation(robot, rigid)
        allocation((0.5, 0.0), feedback=(30.0, 0.0))
        excess = allocation.excess.copy()
        take_loss(np.zeros(2), rigid, allocation._record[0])
        assert np.array_equal(allocation.excess, excess)
        take_loss(np.array([-5.0, -1.0]), rigid, allocation._record[0])
        assert allocation.excess - excess == pytest.approx([-3.0, 0.0 if rigid else 2.0])
        allocation((0.5, 0.0), feedback=(3.0, 0.0))
        assert not allocation.saturated
        take_loss(np.array([0.0, 0.1]), rigid, allocation._record[0])
        assert allocation.saturated
