"""Equation (3) against Newton and Euler, an energy balance, and the seven defects of the print."""

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from mrctl.theory import dynamics as d
from mrctl.theory.kinematics import wheel_rates

RNG = np.random.default_rng(0)
TWISTS = RNG.uniform([-1.5, -3], [1.5, 3], (60, 2))
VOLTAGES = RNG.uniform(-20, 20, (60, 2))
ACCELERATIONS = RNG.uniform([-1.5, -6], [1.5, 6], (60, 2))
LOSSLESS = {"no_load_current": 0.0, "gear_loss": 0.0, "rolling_coefficient": 0.0}
BARE = LOSSLESS | {"com_offset": 0.0, "rotor_inertia": 0.0, "wheel_inertia": 1e-15, "front_wheel_inertia": 0.0}

speeds, rotations = st.floats(-1.5, 1.5), st.floats(-3, 3)
twists = st.tuples(speeds, rotations)
smoothing = st.sampled_from([0.0, 0.05])


@pytest.fixture(scope="module")
def lossless(robot):
    """Returns the robot without friction."""
    return robot.model_copy(update=LOSSLESS)


@pytest.fixture(scope="module")
def bare(robot):
    """Returns the robot that the printed equation describes: a mass and two motors, without friction."""
    return robot.model_copy(update=BARE)


@pytest.fixture(scope="module")
def newton_euler():
    """(V̇, θ̈) from Newton and Euler about the centre of mass, with free forces at every contact, by sympy."""
    t = sp.Symbol("t")
    m, j, c, dd, r, jw, jf, rf = sp.symbols("m j c D r J_w J_f r_f", positive=True)
    pr, pl, v, w = sp.symbols("P_r P_l V omega")
    vd, wd, fr, fl, ff, side = sp.symbols("Vdot omegadot F_r F_l F_f Y")
    theta, speed = sp.Function("theta")(t), sp.Function("speed")(t)
    forward, left = sp.Matrix([sp.cos(theta), sp.sin(theta)]), sp.Matrix([-sp.sin(theta), sp.cos(theta)])
    velocity = speed * forward + (c * forward).diff(t)  # of the centre of mass; P's has no lateral part
    rates = [(theta.diff(t, 2), wd), (theta.diff(t), w), (speed.diff(t), vd), (speed, v)]
    along, across = (sp.simplify(velocity.diff(t).dot(axis)).subs(rates) for axis in (forward, left))
    solution = sp.solve(
        [
            m * along - (fr + fl + ff),
            m * across - side,  # the lateral force of the rear tyres acts at P
            j * wd - (dd * (fr - fl) - c * side),
            jw * (vd + dd * wd) / r - (pr - r * fr),
            jw * (vd - dd * wd) / r - (pl - r * fl),
            jf * vd / rf + rf * ff,
        ],
        [vd, wd, fr, fl, ff, side],
        dict=True,
    )[0]
    return sp.lambdify([m, j, c, dd, r, jw, jf, rf, pl, pr, v, w], [solution[vd], solution[wd]])


def test_newton_euler(lossless, newton_euler):
    """The terms m c θ̇², m c V θ̇ and the effective inertias are those of the rigid body on rolling wheels."""
    b = lossless
    torques = b.motor_gain * (VOLTAGES - b.back_emf * wheel_rates(TWISTS, b))
    expected = newton_euler(
        b.mass, b.yaw_inertia, b.com_offset, b.half_track, b.wheel_radius,
        b.wheel_inertia + b.gear_ratio**2 * b.rotor_inertia, b.front_wheel_inertia, b.front_wheel_radius,
        *torques.T, *TWISTS.T,
    )  # fmt: skip
    np.testing.assert_allclose(d.accelerations(TWISTS, VOLTAGES, b), np.transpose(expected), rtol=1e-10)


def test_energy_balance(robot):
    """Electrical power = change of kinetic energy + heat in the windings + friction of drives, front and rear tyres."""
    b = robot.model_copy(update={"drive_gain": 0.8})
    rates = wheel_rates(TWISTS, b)
    applied = 0.8 * VOLTAGES
    current = (applied - b.gear_ratio * b.torque_constant * rates) / b.resistance
    v_dot, omega_dot = d.accelerations(TWISTS, VOLTAGES, b).T
    v, omega = TWISTS.T
    kinetic = b.effective_mass * v * v_dot + b.effective_inertia * omega * omega_dot
    heat = b.resistance * np.sum(current**2, axis=-1)
    drives = b.drive_loss * np.sum(np.abs(rates), axis=-1)
    rear = (1 - b.front_load) / 2 * b.rolling_force * b.wheel_radius * np.sum(np.abs(rates), axis=-1)
    front = b.front_load * b.rolling_force * np.where(np.prod(rates, axis=-1) > 0, np.abs(v), 0)
    power = np.sum(applied * current, axis=-1)
    np.testing.assert_allclose(power, kinetic + heat + drives + rear + front, rtol=1e-10)


@given(twists, st.tuples(st.floats(-24, 24), st.floats(-24, 24)), smoothing)
def test_inverse_of_forward(robot, twist, voltage, sign_speed):
    """The inverse finds the voltages that were applied."""
    weak = robot.model_copy(update={"drive_gain": 0.7})
    acceleration = d.accelerations(twist, voltage, weak, sign_speed)
    np.testing.assert_allclose(d.inverse_dynamics(twist, acceleration, weak, sign_speed), voltage, atol=1e-10)


@given(twists, st.tuples(st.floats(-24, 24), st.floats(-24, 24)))
def test_viscous_friction(robot, twist, voltage):
    """It takes b ω from the torque of each drive, and the inverse dynamics gives the volts for that."""
    sticky = robot.model_copy(update={"wheel_damping": 0.07})
    less = d.wheel_torques(voltage, twist, robot) - d.wheel_torques(voltage, twist, sticky)
    np.testing.assert_allclose(less, 0.07 * wheel_rates(twist, robot), atol=1e-12)
    acceleration = d.accelerations(twist, voltage, sticky)
    np.testing.assert_allclose(d.inverse_dynamics(twist, acceleration, sticky), voltage, atol=1e-9)
    mixed = d.regressor(twist, acceleration, sticky) @ d.inverse_coefficients(sticky)
    np.testing.assert_allclose(d.left_right(mixed), voltage, atol=1e-9)


@given(twists, st.tuples(speeds, rotations), smoothing)
def test_regressor_linear(robot, twist, acceleration, sign_speed):
    """Eight features and their coefficients are the inverse dynamics."""
    weak = robot.model_copy(update={"drive_gain": 0.7})
    features = d.regressor(twist, acceleration, weak, sign_speed)
    expected = d.common_differential(d.inverse_dynamics(twist, acceleration, weak, sign_speed))
    np.testing.assert_allclose(features @ d.inverse_coefficients(weak), expected, atol=1e-10)


def test_coefficients_fitted(robot):
    """Least squares on samples of the forward model finds the coefficients."""
    features = d.regressor(TWISTS, d.accelerations(TWISTS, VOLTAGES, robot), robot)
    fitted = np.linalg.lstsq(features, d.common_differential(VOLTAGES))[0]
    np.testing.assert_allclose(fitted, d.inverse_coefficients(robot), atol=1e-10)


def test_documented_inverse(robot):
    """Driving forward on both wheels, the formula of the documentation with the full F_roll sgn V, term by term."""
    b, (v, w), (v_dot, w_dot) = robot, (0.8, 1.2), (0.5, -2.0)
    common = b.effective_mass * v_dot - b.mass * b.com_offset * w**2 + 0.015 * 20 * 9.81
    turning = b.effective_inertia * w_dot + b.mass * b.com_offset * v * w
    expected = [
        b.resistance * b.wheel_radius / (43 * 0.0234) * (common / 2 + side * turning / (2 * b.half_track))
        + 43 * 0.0234 * (v + side * b.half_track * w) / b.wheel_radius
        + b.resistance / (43 * 0.0234) * (43 * 0.0234 * 0.037 + 0.1)
        for side in (-1, 1)
    ]
    np.testing.assert_allclose(d.inverse_dynamics([v, w], [v_dot, w_dot], b), expected)


def test_mirror(robot):
    """Swapping the voltages and turning the other way mirrors the motion."""
    mirrored = d.accelerations(TWISTS * [1, -1], VOLTAGES[:, ::-1], robot)
    np.testing.assert_allclose(mirrored, d.accelerations(TWISTS, VOLTAGES, robot) * [1, -1], atol=1e-12)


def test_mix():
    """U_r,l = U_Σ ± U_Δ, and back."""
    np.testing.assert_array_equal(d.left_right([5.0, 2.0]), [3, 7])
    np.testing.assert_allclose(d.common_differential(d.left_right(VOLTAGES)), VOLTAGES)


def test_rest(robot):
    """Friction does not drive a robot at rest, and adds no energy in any motion."""
    np.testing.assert_array_equal(d.accelerations([0, 0], [0, 0], robot), 0)
    coasting = d.accelerations(TWISTS, [0, 0], robot)
    assert np.all(np.sum(coasting * TWISTS * [robot.effective_mass, robot.effective_inertia], axis=-1) < 0)


def test_turning_on_the_spot(robot):
    """For wheels that turn against each other the rolling loss is a torque, and no force."""
    force, torque = d.rolling_losses([0.0, 1.0], robot)
    assert force == 0
    assert torque == pytest.approx(0.188 * 0.015 * 20 * 9.81 * (1 - 0.1 / 0.37))


def test_sign_smoothing(robot):
    """Far from rest the smooth signs are the signs; at rest their slope is 1/sign_speed."""
    np.testing.assert_allclose(d.wheel_signs([1.0, 0.5], robot, 0.05), 1, atol=1e-12)
    np.testing.assert_allclose(d.wheel_signs([1e-6, 0.0], robot, 0.05), 2e-5)
    np.testing.assert_array_equal(d.wheel_signs([0.1, 1.0], robot), [-1, 1])


def settle(robot, mixed, seconds=6.0, step=1e-3):
    """Returns the twist from rest under constant (U_Σ, U_Δ) at every step, by Euler's method."""
    twist, path = np.zeros(2), []
    for _ in range(round(seconds / step)):
        twist = twist + step * d.accelerations(twist, d.left_right(mixed), robot)
        path.append(twist)
    return np.array(path)


@pytest.mark.parametrize(("channel", "gain", "lag"), [(0, 0.0974, 0.23), (1, 0.518, 0.26)])
def test_step_response(lossless, channel, gain, lag):
    """Each channel alone is a first-order lag with the stated static gain and time constant.

    The voltage is small: the offset c couples the channels, and at U_Δ = 2 V costs 1.4 % of the rotation.
    """
    path = settle(lossless, 0.2 * np.eye(2)[channel])[:, channel]
    assert path[-1] == pytest.approx(0.2 * gain, rel=1e-3)
    assert 1e-3 * np.argmax(path > (1 - np.exp(-1)) * path[-1]) == pytest.approx(lag, abs=6e-3)


def test_motor_limits(lossless):
    """No-load speed 2.34 m/s and stall torque 10.4 N·m at the supply; more voltage than the supply changes nothing."""
    assert settle(lossless, [24.0, 0.0])[-1, 0] == pytest.approx(2.34, abs=0.01)
    np.testing.assert_allclose(d.wheel_torques([24, -24], [0, 0], lossless), [10.4, -10.4], atol=0.05)
    np.testing.assert_array_equal(
        d.wheel_torques([99, -99], [0, 0], lossless), d.wheel_torques([24, -24], [0, 0], lossless)
    )


def test_batches(robot):
    """Any leading dimensions, and one twist for many voltages, give the rows one by one."""
    grid = VOLTAGES.reshape(6, 10, 2)
    for law in (d.accelerations, d.accelerations_as_printed, d.inverse_dynamics, d.regressor):
        np.testing.assert_array_equal(law([0.5, 1.0], grid, robot)[2, 3], law([0.5, 1.0], grid[2, 3], robot))


def test_defect_1_second_derivative(robot):
    """The printed V̈ has the unit of V̇: with seconds replaced by a unit s times shorter it grows as s⁻², not s⁻³."""
    s = 10.0
    units = {"resistance": s**-3, "torque_constant": s**-2}  # kg m² s⁻³ A⁻², kg m² s⁻² A⁻¹; the rest has no seconds
    other = robot.model_copy(update={name: factor * getattr(robot, name) for name, factor in units.items()})
    printed = d.accelerations_as_printed(TWISTS, VOLTAGES, robot)
    rescaled = d.accelerations_as_printed(TWISTS / s, VOLTAGES * s**-3, other)
    np.testing.assert_allclose(rescaled, printed * s**-2)


def test_defect_1_growth(bare):
    """Under a constant torque a mass gains speed linearly; the printed V̈ integrated twice is quadratic."""
    push = d.accelerations_as_printed([0, 0], [5, 5], bare)[0]
    time = np.linspace(0, 1, 1001)[1:]
    literal = np.cumsum(np.cumsum(np.full(1000, push))) * 1e-6
    true = d.accelerations([0, 0], [5, 5], bare)[0] * time
    exponent = [np.polyfit(np.log(time[100:]), np.log(speed[100:]), 1)[0] for speed in (literal, true)]
    np.testing.assert_allclose(exponent, [2, 1], atol=0.01)


def test_defect_2_half_force(bare):
    """1/(2r) gives half the acceleration of the same mass under the same torques."""
    printed, corrected = (law(TWISTS, VOLTAGES, bare) for law in (d.accelerations_as_printed, d.accelerations))
    np.testing.assert_allclose(printed[:, 0], corrected[:, 0] / 2, atol=1e-9)
    half = bare.model_copy(update={"mass": bare.mass / 2})
    np.testing.assert_allclose(d.accelerations_as_printed(TWISTS, VOLTAGES, half)[:, 0], corrected[:, 0], atol=1e-9)


def test_defect_3_torque_factor(bare):
    """r/(2D) for D/r makes the turn too weak by r²/(2D²), 0.136 here, and wider robots turn worse, not better."""
    printed, corrected = (law(TWISTS, VOLTAGES, bare)[:, 1] for law in (d.accelerations_as_printed, d.accelerations))
    np.testing.assert_allclose(printed, 0.1359 * corrected, rtol=1e-3)
    wide = bare.model_copy(update={"half_track": 2 * bare.half_track})
    gain = [law([0, 0], [-1, 1], wide)[1] / law([0, 0], [-1, 1], bare)[1]
            for law in (d.accelerations_as_printed, d.accelerations)]  # fmt: skip
    np.testing.assert_allclose(gain, [0.5, 2], rtol=1e-6)


def test_defect_4_unsigned_loss(robot):
    """As printed a resting robot without voltage drives backwards, and the loss pushes a reversing one."""
    assert d.accelerations_as_printed([0, 0], [0, 0], robot)[0] < 0
    np.testing.assert_array_equal(d.accelerations([0, 0], [0, 0], robot), 0)
    loss = robot.torque_constant * 43 * 0.037
    free = robot.model_copy(update={"no_load_current": 0.0})
    forward, back = (
        d.wheel_torques_as_printed([0, 0], [v, v], robot, 1e-3) - d.wheel_torques_as_printed([0, 0], [v, v], free, 1e-3)
        for v in (1.0, -1.0)
    )
    np.testing.assert_allclose([forward, back], -loss)
    signed = [(d.wheel_torques([0, 0], [v, 0], robot) - d.wheel_torques([0, 0], [v, 0], free))[0] for v in (1, -1)]
    np.testing.assert_allclose(signed, [-loss, loss])


def test_defect_5_names(robot):
    """One order, (left, right): the right voltage moves the right torque alone and turns left; torque is no input."""
    for torques in (
        lambda u, v: d.wheel_torques(u, [v, 0], robot),
        lambda u, v: d.wheel_torques_as_printed(u, [v, v], robot, robot.torque_constant * d.RAD_S_PER_RPM),
    ):
        change = torques([1, 2], 0.0) - torques([1, 1], 0.0)
        assert change[0] == 0 and change[1] == pytest.approx(robot.motor_gain)
        assert torques([1, 1], 0.5)[0] < torques([1, 1], 0.1)[0]  # the same voltage, another torque
    for law in (d.accelerations, d.accelerations_as_printed):
        assert law([0.0, 0.0], [1, 2], robot)[1] > law([0.0, 0.0], [1, 1], robot)[1]


@pytest.mark.parametrize(
    "change",
    [
        {"rotor_inertia": 5e-6}, {"wheel_inertia": 1e-2}, {"com_offset": 0.2}, {"rolling_coefficient": 0.1},
        {"gear_loss": 0.5}, {"supply": 6.0},
    ],
)  # fmt: skip
def test_defect_6_left_out(robot, change):
    """Parameters that are missing in the printed equation change the corrected one."""
    other = robot.model_copy(update=change)
    twist, voltage = [0.5, 1.0], [10.0, 14.0]
    printed, corrected = d.accelerations_as_printed, d.accelerations
    np.testing.assert_array_equal(printed(twist, voltage, other), printed(twist, voltage, robot))
    assert np.max(np.abs(corrected(twist, voltage, other) - corrected(twist, voltage, robot))) > 1e-2


def test_defect_7_rpm(bare):
    """With k_E in V/rpm the printed torques are the corrected ones; with k_E in SI back-EMF is 60/2π too large."""
    speeds = bare.wheel_radius * wheel_rates(TWISTS, bare)
    per_rpm = bare.torque_constant * 2 * np.pi / 60
    assert per_rpm == pytest.approx(2.457e-3, rel=5e-3)  # the data sheet's
    corrected = d.wheel_torques(VOLTAGES, TWISTS, bare)
    np.testing.assert_allclose(d.wheel_torques_as_printed(VOLTAGES, speeds, bare, per_rpm), corrected, atol=1e-12)
    emf = d.wheel_torques([0, 0], TWISTS, bare)
    printed = d.wheel_torques_as_printed([0, 0], speeds, bare, bare.torque_constant)
    np.testing.assert_allclose(printed, emf * 60 / (2 * np.pi))
