"""Motor driver, battery and steering servo: each law against its formula, and in physics against analytic values."""

import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrctl.physics import mjcf
from mrctl.physics.files import models_folder
from mrctl.physics.plant import IDEAL_DRIVER, IDEAL_SERVO, BatchPlant, PhysicsPlant
from mrctl.theory.drive import DRIVER, NO_LIMIT, SERVO, Driver, SteeringServo, chop, drive, turn
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.robot import Steering

MODEL, ROBOT = mjcf.build()
SUBSTEPS = 5
SUPPLY, R, NK = 24.0, 2.32, 43 * 0.0234  # V, Ω, V·s/rad at the wheel
RESISTANCE = np.array([R, R])
NOMINAL = Perturbation()


def plants(
    driver=IDEAL_DRIVER, servo=IDEAL_SERVO, perturbation=NOMINAL, steering: Steering = "compliant", twist=(0, 0)
):
    """Yields a plant of each kind at the origin; the last robot has this driver, servo and perturbation."""
    model, robot = mjcf.build("flat", steering)
    for plant in (PhysicsPlant([model], robot, SUBSTEPS), BatchPlant([model] * 3, robot, SUBSTEPS)):
        plant.perturb(plant.size - 1, perturbation, 0, driver, servo)
        plant.reset(np.zeros((plant.size, 3)), np.tile(twist, (plant.size, 1)))
        yield plant


def command(plant, left, right=None, angle=0.0, rate=0.0):
    """Returns the same command for every robot."""
    return np.tile([left, left if right is None else right, angle, rate], (plant.size, 1))


def sent(volts, emf=(0.0, 0.0), **fields):
    """Returns the voltages that a driver sends, `(2,)`, and its record."""
    d = np.zeros(1, DRIVER)[0]
    d["supply"], d["gain"], d["current_limit"] = SUPPLY, 1.0, np.inf
    for name, value in fields.items():
        d[name] = value
    voltage = np.zeros(2)
    drive(np.array(volts, float), np.array(emf, float), RESISTANCE, d, voltage)
    return voltage, d


def test_dead_zone():
    """A command below it gives no voltage, one above it the full one, in both directions."""
    for volts in (0.0, 0.49, -0.49):
        assert np.array_equal(sent((volts, volts), dead_zone=0.5)[0], [0, 0])
    assert np.array_equal(sent((0.5, -0.51), dead_zone=0.5)[0], [0.5, -0.51])


def test_pwm_steps():
    """A sweep of the command gives n + 1 voltages from 0 to the supply, evenly spaced, never half a step off."""
    commands = np.linspace(0, SUPPLY, 2001)
    found = np.array([sent((c, -c), pwm_steps=16)[0] for c in commands])
    assert np.array_equal(found[:, 0], -found[:, 1])
    assert np.unique(found[:, 0]) == pytest.approx(np.linspace(0, SUPPLY, 17))
    assert np.abs(found[:, 0] - commands).max() <= SUPPLY / 32 + 1e-12


def test_order():
    """The dead zone meets the command, not its rounded value; a supply factor then scales the duty."""
    voltage, _ = sent((0.9, 1.1), dead_zone=1.0, pwm_steps=10, gain=0.5)
    assert voltage == pytest.approx([0.0, 0.0])  # 1.1 V is less than half a step of 2.4 V
    voltage, _ = sent((2.5, 23.0), dead_zone=1.0, pwm_steps=10, gain=0.5)
    assert voltage == pytest.approx([1.2, 12.0])


VOLTS = st.floats(-SUPPLY, SUPPLY)
SPEEDS = st.floats(-20, 20)  # V of back-EMF


@given(st.tuples(VOLTS, VOLTS), st.tuples(SPEEDS, SPEEDS), st.floats(0.01, 0.5), st.floats(0.5, 1.5))
def test_sag(volts, emf, battery, gain):
    """Kirchhoff's law of the whole circuit, and what the battery gives is what the motors take and it loses itself."""
    voltage, d = sent(volts, emf, battery_resistance=battery, gain=gain)
    rail, duty = d["scale"] * SUPPLY, np.array(volts) / SUPPLY
    current = (voltage - emf) / R
    assert rail == pytest.approx(gain * SUPPLY - battery * duty @ current, abs=1e-9)
    given_off = gain * SUPPLY * (duty @ current)  # at the battery's open-circuit voltage
    assert given_off == pytest.approx(voltage @ current + battery * (duty @ current) ** 2, abs=1e-7)
    assert given_off >= voltage @ current - 1e-7


@given(st.tuples(VOLTS, VOLTS), st.tuples(st.floats(0, 15), st.floats(0, 15)), st.floats(0.01, 0.3))
def test_sag_under_a_limit(volts, emf, battery):
    """A motor at its current limit takes U i, not what it would take without; found by bisection instead."""
    limit = 4.0
    voltage, d = sent(np.abs(volts), emf, battery_resistance=battery, current_limit=limit)
    duty = np.abs(volts) / SUPPLY

    def missing(rail):
        terminal = [chop(duty[k] * rail, emf[k], R, limit) for k in range(2)]
        power = sum(u * (u - e) / R for u, e in zip(terminal, emf, strict=True))
        return rail - SUPPLY + battery * power / rail

    low, high = SUPPLY / 2, 2 * SUPPLY
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if missing(middle) < 0 else (low, middle)
    assert d["scale"] * SUPPLY == pytest.approx(low, rel=2e-3)


@given(
    st.tuples(VOLTS, VOLTS), st.tuples(st.floats(-50, 50), st.floats(-50, 50)), st.floats(0.01, 4), st.floats(0.1, 50),
)  # fmt: skip
def test_sag_of_anything(volts, emf, battery, limit):
    """A weak battery, motors that are driven backwards, any limit: the voltage is finite and never turns around."""
    voltage, d = sent(volts, emf, battery_resistance=battery, current_limit=limit, gain=0.5)
    assert np.isfinite(voltage).all() and 0 <= d["scale"] < 50
    assert (voltage * np.sign(volts) >= 0).all()


def test_sag_of_a_stalled_robot():
    """Both motors at rest and full duty: U = U_0/(1 + 2 R_b/R), a voltage divider."""
    _, d = sent((SUPPLY, -SUPPLY), battery_resistance=0.15)
    assert d["scale"] == pytest.approx(1 / (1 + 2 * 0.15 / R))
    voltage, d = sent((1.0, 1.0), battery_resistance=0.15)
    assert voltage[0] == pytest.approx(1 / (1 + 2 * (1 / SUPPLY) ** 2 * 0.15 / R))


@given(st.floats(-50, 50), st.floats(-25, 25), st.floats(0.1, 20))
def test_chop(voltage, emf, limit):
    """The current is within its limit, the voltage is untouched if it was, and never overshoots the command."""
    found = chop(voltage, emf, R, limit)
    assert abs(found - emf) / R <= limit * (1 + 1e-12) + 1e-9
    if abs(voltage - emf) / R <= limit:
        assert found == voltage
    assert chop(voltage, emf, R, np.inf) == voltage


def test_stall():
    """At rest against a wall of losses, the current is U/R, or the limit; the driver reports the rest as lost."""
    stuck = Perturbation(drive_friction_factor=20.0, mass_factor=20.0)  # 6 V do not move it
    for limit, expected in ((NO_LIMIT, 6 / R), (2.0, 2.0)):
        for plant in plants(Driver(current_limit=limit), perturbation=stuck):
            for _ in range(20):
                plant.step(command(plant, 6.0))
            assert abs(plant.reading["twist"][-1, 0]) < 1e-3
            assert plant.current[-1] == pytest.approx([expected] * 2, rel=1e-3)
            assert plant.applied[-1] == pytest.approx([expected * R] * 2, rel=1e-3)
            assert plant.state["lost"][-1] == pytest.approx([expected * R - 6] * 2, abs=5e-3)


@pytest.mark.parametrize("inductance", ["0 0", "2.4e-4 0"])
def test_limit_within_the_period(tmp_path, inductance):
    """The torque of the engine never belongs to more than the limit, in no physics step of a start and a reversal."""
    folder = shutil.copytree(models_folder(), tmp_path / "models")
    text = (folder / "car.xml").read_text()
    (folder / "car.xml").write_text(text.replace('resistance="2.32"', f'resistance="2.32" inductance="{inductance}"'))
    model, robot = mjcf.build(str(folder / "flat.xml"))
    plant = PhysicsPlant([model], robot, SUBSTEPS)
    plant.perturb(0, Perturbation(motor_constant_factor=0.9), 0, Driver(current_limit=3.0))
    plant.reset(np.zeros((1, 3)), np.zeros((1, 2)))
    currents = []
    for tick in range(80):
        plant.send(command(plant, 24.0 if tick < 40 else -24.0))
        for _ in range(SUBSTEPS):
            plant.physics.step(1)
            currents.append(plant.physics.data.actuator_force[:2] / (0.9 * 0.0234))
        plant.look()
        assert np.abs(plant.current).max() <= 3 + 1e-9
        assert (plant.state["lost"][0] < 0).all() if tick < 40 else (plant.state["lost"][0] > 0).all()
    assert np.abs(currents).max() <= 3 + 1e-9
    assert np.mean(np.abs(currents) > 2.99) > 0.98


def test_limited_acceleration():
    """A robot whose current is limited accelerates with F/M_e, F = 2 N k_M I/r − losses, whatever the voltage."""
    for plant in plants(Driver(current_limit=2.0)):
        speeds = []
        for _ in range(40):
            plant.step(command(plant, 24.0))
            speeds.append(plant.reading["twist"][-1, 0])
        force = 2 * NK * 2.0 / 0.098 - 2 * ROBOT.drive_loss / 0.098 - ROBOT.rolling_force
        gained = speeds[-1] - speeds[9]
        assert gained == pytest.approx(force / ROBOT.effective_mass * 0.3, rel=0.02)
        if plant.size > 1:
            assert plant.reading["twist"][0, 0] > 2 * plant.reading["twist"][-1, 0]


def test_no_load():
    """A robot at its top speed draws so little current that neither limit nor battery is felt."""
    for plant in plants(Driver(current_limit=2.0, battery_resistance=0.1), twist=(1.2, 0.0)):
        for _ in range(300):
            plant.step(command(plant, 14.0))
        current = (ROBOT.drive_loss + ROBOT.rolling_force * 0.098 / 2) / NK
        assert plant.current[-1] == pytest.approx([current] * 2, rel=0.03)
        assert not plant.state["lost"][-1].any()
        rail = SUPPLY - 0.1 * 2 * (14 / SUPPLY) * current
        assert plant.state["driver"]["scale"][-1] * SUPPLY == pytest.approx(rail, abs=2e-3)


def test_dead_robot():
    """Below the dead zone a robot does not move, with a voltage that would move it otherwise."""
    weak = Perturbation(drive_friction_factor=0.1, dead_zone=0.8)
    for plant in plants(Driver(dead_zone=0.4), perturbation=weak):
        for _ in range(50):
            plant.step(command(plant, 1.19))
        assert abs(plant.reading["pose"][-1, 0]) < 1e-4 and not plant.applied[-1].any()
        for _ in range(50):
            plant.step(command(plant, 1.21))
        assert plant.reading["pose"][-1, 0] > 1e-2


def servo(**fields):
    """Returns a record of `SERVO`."""
    s = np.zeros(1, SERVO)[0]
    for name, value in fields.items():
        s[name] = value
    return s


def test_backlash_loop():
    """A triangle of amplitude a through a play b: edges b/2 behind, plateaus of width b, an area of b (2 a − b)."""
    a, b, n = 0.2, 0.06, 2000
    s = servo(backlash=b)
    cycle = np.concatenate([np.linspace(-a, a, n), np.linspace(a, -a, n)])
    # the first of two cycles begins somewhere in the play
    found = [turn(angle, 1.0 if k < n else -1.0, s) for _ in range(2) for k, angle in enumerate(cycle)]
    angle, rate = np.array(found[len(cycle) :]).T
    assert angle.max() == pytest.approx(a - b / 2) and angle.min() == pytest.approx(-a + b / 2)
    up, down = angle[:n], angle[n:]
    assert up[n // 2 :] == pytest.approx(cycle[n // 2 : n] - b / 2)
    assert down[n // 2 :] == pytest.approx(cycle[n + n // 2 :] + b / 2)
    area = abs(np.trapezoid(angle, cycle))
    assert area == pytest.approx(b * (2 * a - b), rel=5e-3)
    still = np.abs(np.diff(angle)) < 1e-12
    differ = still != (rate[1:] == 0)  # the fork has the rate of the set-point, or stands; a turn takes one sample
    assert np.count_nonzero(differ) <= 4
    assert np.mean(still) == pytest.approx(b / (2 * a), abs=2e-3)


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=30), st.floats(0, 0.3), st.floats(-0.3, 0.3))
def test_play(angles, backlash, offset):
    """The fork is never further than half the backlash from its set-point, and moves only when it must."""
    s, before = servo(backlash=backlash, offset=offset), 0.0
    for angle in angles:
        found, rate = turn(angle, 0.7, s)
        assert abs(found - offset - angle) <= backlash / 2 + 1e-12
        assert found - offset == pytest.approx(min(max(before, angle - backlash / 2), angle + backlash / 2), abs=1e-12)
        before = found - offset
        assert rate == (0.0 if abs(angle - before) < backlash / 2 - 1e-9 else rate)


def test_no_backlash():
    """Without imperfections the set-point goes through to the bit, with its rate."""
    s = servo()
    for angle, rate in np.random.default_rng(0).normal(size=(100, 2)):
        assert turn(angle, rate, s) == (angle, rate)


def test_offset_in_physics():
    """An offset of the fork bends the path of a robot that is steered straight ahead: κ = tan(offset)/L."""
    offset = 0.05
    for plant in plants(
        servo=SteeringServo(offset=0.03), perturbation=Perturbation(steering_offset=0.02), steering="rigid"
    ):
        for _ in range(300):
            plant.step(command(plant, 6.0))
        v, omega = plant.reading["twist"][-1]
        assert omega / v == pytest.approx(np.tan(offset) / 0.40, rel=0.03)
        if plant.size > 1:
            assert abs(plant.reading["twist"][0, 1]) < 1e-6


def test_backlash_in_physics():
    """The fork of a robot on the road stops half the backlash before a slow set-point, from either side."""
    for plant in plants(servo=SteeringServo(backlash=0.04), steering="rigid"):
        for sign in (1, -1):
            for tick in range(300):
                plant.step(command(plant, 6.0, angle=sign * min(0.1, 0.001 * tick)))
            assert plant.reading["steering_angle"][-1] == pytest.approx(sign * 0.08, abs=0.003)


def test_forgotten():
    """A robot that stands up again has neither lost voltage nor play in its servo; the others keep theirs."""
    *_, plant = plants(Driver(current_limit=2.0), SteeringServo(backlash=0.1))
    for row in range(plant.size):
        plant.perturb(row, Perturbation(), 0, Driver(current_limit=2.0), SteeringServo(backlash=0.1))
    for _ in range(10):
        plant.step(command(plant, 20.0, angle=0.2))
    before = plant.state[[0, 2]].copy()
    assert (before["lost"] < 0).all() and before["servo"]["play"] == pytest.approx([0.15] * 2)
    plant.restart(1, np.zeros(3), np.zeros(2))
    assert not plant.state["lost"][1].any() and plant.state["servo"]["play"][1] == plant.reading["steering_angle"][1]
    for name in ("lost", "applied", "servo"):
        assert np.array_equal(plant.state[[0, 2]][name], before[name])
    plant.reset(np.zeros((3, 3)), np.zeros((3, 2)))
    assert not plant.state["lost"].any()
    assert np.array_equal(plant.state["servo"]["play"], plant.reading["steering_angle"])


def test_what_adds_up():
    """A perturbation adds to the driver and the servo, and the narrower limit counts."""
    p = Perturbation(
        dead_zone=0.2, pwm_steps=200, current_limit=5.0, battery_resistance=0.1, steering_offset=-0.01,
        steering_backlash=0.02,
    )  # fmt: skip
    mine = Driver(dead_zone=0.3, pwm_steps=100, current_limit=8.0, battery_resistance=0.05)
    found = p.of_driver(mine)
    assert found.model_dump() == pytest.approx(
        {"dead_zone": 0.5, "pwm_steps": 100, "current_limit": 5.0, "battery_resistance": 0.15}
    )
    assert p.of_driver(Driver()).pwm_steps == 200 and Perturbation().of_driver(mine) == mine
    assert p.of_servo(SteeringServo(offset=0.03, backlash=0.01)).model_dump() == pytest.approx(
        {"offset": 0.02, "backlash": 0.03}
    )
    assert (
        Perturbation().of_driver(Driver()) == Driver() and Perturbation().of_servo(SteeringServo()) == SteeringServo()
    )
