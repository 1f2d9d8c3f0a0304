"""T measured in the loop: the estimator on a known system, the physics against equation (3), and what T foretells."""

from functools import cache

import numpy as np
import pytest
from matplotlib.colors import to_hex
from scipy import signal

import mrctl
from mrctl.control.kanayama import Kanayama
from mrctl.control.margins import sampled_loop
from mrctl.control.pid import Pid
from mrctl.experiments import response as excitation
from mrctl.experiments import tuning
from mrctl.experiments.paper import IDEAL
from mrctl.experiments.response import PERIOD_TICKS, Shaker, estimate, lines, measure, multisine, refine, safety
from mrctl.experiments.tuning import design, statement
from mrctl.loop.hierarchy import HAND_OVER_SHARE
from mrctl.loop.simulation import Simulation
from mrctl.physics.mjcf import load
from mrctl.physics.parameters import read_robot
from mrctl.theory.linear import first_order
from mrctl.theory.robot import RobotFile

H = 0.01
NO_MOTION_CONTROLLER = Kanayama(k_x=0, k_y=0, k_theta=0)
ROBOT = read_robot(load("flat"))
PIDS = {"normal": Pid(time_constant=0.15), "fast": Pid(time_constant=0.075)}


def scenarios(delays=(0.0,), **changes):
    return [
        mrctl.Scenario(
            perturbation=mrctl.Perturbation(control_delay=d), **IDEAL | {"kanayama": NO_MOTION_CONTROLLER} | changes
        )
        for d in delays
    ]


@cache
def designed(pid, delays, robot, ticks=PERIOD_TICKS):
    """The table of the design of a robot, which several tests read, by an excitation of a period of so many ticks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(excitation, "PERIOD_TICKS", ticks)
        return design("flat", pid, delays, RobotFile(path=robot))


def on_paper(frequency, channel, delay, pid="normal"):
    """T of equation (3) under the sampled PI."""
    robot = read_robot(load("flat"))
    plant = (
        first_order(robot.velocity_gain, robot.velocity_time_constant),
        first_order(robot.rotation_gain, robot.rotation_time_constant),
    )[channel]
    loop = sampled_loop(frequency, plant, PIDS[pid].channels(robot, rigid=False)[channel], H, delay)
    return loop / (1 + loop)


@pytest.mark.parametrize("samples", [200, 1000])
def test_multisine(samples):
    """Odd harmonics of amplitude one below Nyquist and nothing else, and no higher than a few times their RMS."""
    harmonics = lines(samples)
    wave = multisine(samples, harmonics)
    assert (harmonics % 2 == 1).all() and harmonics[0] == 1 and harmonics[-1] == samples / 2 - 1
    spectrum = np.zeros(samples // 2 + 1)
    spectrum[harmonics] = 1
    np.testing.assert_allclose(np.abs(np.fft.rfft(wave)) * 2 / samples, spectrum, atol=1e-12)
    assert np.abs(wave).max() < 2.5 * np.sqrt(len(harmonics) / 2)


def test_estimate():
    """Exact on a discrete linear system in its steady state, whatever even harmonics a nonlinearity adds."""
    samples, (b, a) = 400, signal.butter(3, 0.2)
    harmonics = lines(samples)
    wave = multisine(samples, harmonics)
    answer = signal.lfilter(b, a, np.tile(wave, 6))[-samples:]
    expected = signal.freqz(b, a, worN=2 * np.pi * harmonics / samples)[1]
    both = np.stack([answer, -2 * answer + 0.1 * wave**2], axis=1)
    np.testing.assert_allclose(estimate(wave, both, harmonics), [expected, -2 * expected], atol=1e-10)


@pytest.mark.parametrize("pid", ["normal", "fast"])
def test_common_channel_is_equation_3(pid):
    """To 1 % of T's static value at every frequency, without delay and with: model, hold and delay are right."""
    delays = (0.0, 0.02, 0.04)
    frequency, found = measure(scenarios(delays, pid=PIDS[pid]), 0)
    expected = [on_paper(frequency, 0, delay, pid) for delay in delays]
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_second_channel():
    """Of a caster within 15 % of equation (3), by the tyres' slip; a compliant fork takes most of the slow work."""
    frequency, (caster,) = measure(scenarios(steering="caster"), 1)
    np.testing.assert_allclose(caster, on_paper(frequency, 1, 0.0), atol=0.15)
    _, (compliant,) = measure(scenarios(), 1)
    slow = (frequency > 1) & (frequency < 5)
    assert (np.abs(compliant[slow]) < 0.65 * np.abs(caster[slow])).all()
    # Beyond the fork's own motion only the inertia is left.
    np.testing.assert_allclose(compliant[frequency > 100], caster[frequency > 100], atol=0.01)


@pytest.mark.parametrize("steering", ["compliant", "caster", "rigid"])
def test_delay_turns_the_open_loop(steering):
    """A delay T_d turns L = T/(1 − T) by −ωT_d and leaves its size alone, whatever the plant is."""
    delays = (0.0, 0.01, 0.03)
    frequency, t = measure(scenarios(delays, steering=steering), 1)
    loop = t / (1 - t)
    turned = loop[0] * np.exp(-1j * frequency * np.array(delays)[:, None])
    np.testing.assert_allclose(loop, turned, atol=0.02 * np.abs(loop[0]).max())
    middle = (frequency > 5) & (frequency < 60)
    angle = np.angle(loop[1:] / loop[0]) + frequency * np.array(delays)[1:, None]
    assert np.abs(np.exp(1j * angle[:, middle]) - 1).max() < 0.03  # rad


def test_safety_of_a_known_loop():
    """T = e^(−sT_d)/(λs + 1): Re T = 0 where it lags by 90°; an integrator in its loop is stable up to its margin."""
    closed, delay = 0.15, 0.02
    w = np.geomspace(0.5, 300, 100_001)
    t = np.exp(-1j * w * delay) / (1j * w * closed + 1)
    found = safety(w, t, H)
    turning = w[np.argmax(np.arctan(closed * w) + w * delay > np.pi / 2)]
    assert found.positive_to == pytest.approx(turning, rel=1e-3)
    # The integrator 1/(e^(jωh) − 1) lags by 90° + ωh/2.
    critical = w[np.argmax(np.arctan(closed * w) + w * (delay + H / 2) > np.pi / 2)]
    step = 2 * np.sin(critical * H / 2) * np.hypot(closed * critical, 1)
    assert found.step == pytest.approx(step, rel=1e-3)
    assert found.step_handed_over > 10 * found.step
    assert safety(w, 1 / (1j * w * closed + 1), H).positive_to == np.inf
    # (1 + T) e^(jωτ), τ = T_d + 2 h: the first turns back by its phase, the second forth.
    known = safety(w, t, H, delay).built_in_to
    turned = np.angle((1 + np.exp(-1j * known * delay) / (1j * known * closed + 1)) / 2) + known * (delay + 2 * H)
    assert turned == pytest.approx(np.pi / 2, abs=1e-3)


def test_hand_over_turns_the_condition():
    """A stage whose shaking is handed over from the integral is answered by a + (1 − a) T."""

    class HandedOver(Shaker):
        def learn(self, *given):
            before = self.output(None, None)
            super().learn(*given)
            return self.output(None, None) - before

    frequency, (t,) = measure(scenarios(), 0)
    harmonics = lines(PERIOD_TICKS)
    wave = 0.03 * np.stack([multisine(PERIOD_TICKS, harmonics), np.zeros(PERIOD_TICKS)], axis=1)
    shaker = HandedOver(wave, 2 * PERIOD_TICKS, 1)
    line = mrctl.Line(length=16)
    simulation = Simulation(
        [scenarios(reference=line, laps=1, initial_spread=(0, 0, 0))[0]], feedforward=lambda robot, size: shaker
    )
    while simulation.running:
        simulation.step()
    answer = -estimate(wave[:, 0], shaker.feedback[PERIOD_TICKS:, 0, 0], harmonics)
    np.testing.assert_allclose(answer, HAND_OVER_SHARE + (1 - HAND_OVER_SHARE) * t, atol=5e-3)


def test_refine():
    """A smooth response between the lines is found to a thousandth."""
    w = 2 * np.pi / 10 * lines(1000)
    fine, found = refine(w, np.exp(-0.02j * w) / (0.15j * w + 1))
    near = fine < 60
    np.testing.assert_allclose(found[near], (np.exp(-0.02j * fine) / (0.15j * fine + 1))[near], atol=3e-3)


def test_twice_as_fast():
    """Half the λ is about twice the bandwidth and crossover on the physics too, and leaves every loop its margin."""
    normal, fast = (designed(pid, (0.0,), "car") for pid in PIDS.values())
    for slow_loop, fast_loop in zip(normal["loops"], fast["loops"], strict=True):
        for name in ("bandwidth", "crossover"):
            ratio = fast_loop["measured"][name] / slow_loop["measured"][name]
            assert 1.85 < ratio < 2.7, (slow_loop["steering"], name)
        assert fast_loop["measured"]["phase"] > 60
    assert "λ = 0.075 s" in statement(fast)
    assert f"common {fast['loops'][0]['measured']['bandwidth']:.1f} / " in statement(fast)


@pytest.mark.parametrize("robot", ["car", "turtlebot", "racecar"])
@pytest.mark.parametrize(("pid", "delays"), [(Pid(), (0.0, 0.01, 0.02)), (PIDS["normal"], (0.0,))])
def test_designed_is_measured(robot, pid, delays):
    """On the physics every loop has the bandwidth that was designed to 10 %, and M_s, with every steering and delay.

    Designed loops are so fast that a period of 2 s finds the same to two digits; the turtlebot's have the usual 10 s.
    """
    table = designed(pid, delays, robot, *([200] if pid.time_constant is None and robot != "turtlebot" else []))
    assert len(table["loops"]) == len(delays) * (4 if robot == "car" else 2)
    for row in table["loops"]:
        wanted, found = row["design"], row["measured"]
        assert found["bandwidth"] == pytest.approx(wanted["bandwidth"], rel=0.1), (row["steering"], row["delay"])
        assert found["sensitivity"] == pytest.approx(wanted["sensitivity"], abs=0.1)
        if pid.time_constant is None:
            assert found["sensitivity"] < 1.7 and found["bandwidth"] > 35


@pytest.mark.parametrize("late", ["encoder_latency", "gyro_latency"])
def test_late_sensors_are_in_the_design(late):
    """The PID is designed for the delay of the whole chain, on which an estimator waits for its slowest sensor."""
    sensing = mrctl.Sensing(tier="ideal", estimator="odometry", delay=0.01, **{late: 0.02})
    slow = mrctl.Scenario(**IDEAL | {"kanayama": NO_MOTION_CONTROLLER, "pid": Pid(), "sensing": sensing})
    frequency, (t,) = measure([slow], 0)
    plant = first_order(ROBOT.velocity_gain, ROBOT.velocity_time_constant)
    loop = sampled_loop(frequency, plant, Pid(delay=0.03).channels(ROBOT, rigid=False)[0], H, 0.03)
    wanted, found = (np.abs(1 - one).max() for _, one in (refine(frequency, loop / (1 + loop)), refine(frequency, t)))
    assert wanted == pytest.approx(1.6, abs=0.1) and found == pytest.approx(wanted, abs=0.1)


@pytest.mark.parametrize(
    ("points", "speed"),
    [
        (((0.6, 1.7), (-3.4, 1.0), (-3.9, 0.8), (-3.6, -0.7), (-3.0, -2.1), (-0.1, -2.8), (2.7, -2.2)), 0.94),
        (((3.6, 1.9), (2.2, 3.2), (0.3, 2.6), (-3.8, 0.9), (-1.1, -1.8)), 1.35),
    ],
)
def test_a_pid_for_its_plant_keeps_the_robot(points, speed):
    """On splines on which the IMC gains lose a nominal robot, designed gains keep it within 1 mm, also with delay.

    The splines are two of a hundred random ones.
    """
    pids = PIDS["normal"], Pid(delay=0.0), Pid(delay=0.01)
    result = mrctl.simulate(
        [
            mrctl.Scenario(
                reference=mrctl.Waypoints(points=points, speed=speed), laps=1, learner="none",
                perturbation=mrctl.Perturbation(control_delay=pid.delay or 0.0), **IDEAL | {"pid": pid},
            )
            for pid in pids
        ]
    )  # fmt: skip
    assert result["failed"].values.tolist() == [True, False, False]
    assert (mrctl.per_lap(result)["position_rmse"].values[1:, 0] < 1e-3).all()


class Integrator:
    """Feedback-error learning of a constant: U_ff(k + 1) = U_ff(k) + μ U_fb(k) in one channel."""

    def __init__(self, steps, channel):
        self.step = np.array(steps)[:, None] * np.eye(2)[channel]
        self.voltage = np.zeros_like(self.step)

    def output(self, command, derivative):
        return self.voltage

    def learn(self, feedback, frozen, twist, voltage):
        self.voltage = self.voltage + self.step * feedback


@pytest.mark.parametrize(("steering", "channel"), [("compliant", 0), ("compliant", 1), ("caster", 1)])
def test_foretells_instability(steering, channel):
    """Behind 40 ms, learning settles at 0.7 of the step that T allows, and oscillates for ever at 1.3 of it."""
    scenario = mrctl.Scenario(
        **IDEAL, steering=steering, reference=mrctl.Line(length=24), laps=1, guard=mrctl.Guard(on=False),
        perturbation=mrctl.Perturbation(control_delay=0.04),
    )  # fmt: skip
    frequency, (t,) = measure([scenario], channel)
    limit = safety(*refine(frequency, t), H).step
    result = mrctl.simulate(
        [scenario] * 2, feedforward=lambda robot, size: Integrator([0.7 * limit, 1.3 * limit], channel)
    )
    settled, shaken = result["v" if channel == 0 else "omega"].values
    early, late = slice(300, 800), slice(-500, None)
    assert np.std(settled[late]) < 0.2 * np.std(settled[early])
    assert not np.std(shaken[late]) < 0.9 * np.std(shaken[early])  # NaN: it drove off


@pytest.mark.parametrize("count", [7, 8])
def test_delays_in_a_figure(count):
    """Each delay has a colour of its own and an entry in the legend, however many there are."""
    loops = [{"steering": "caster", "channel": channel} for channel in (0, 1)]
    answers = {kind: {"real": [1.0, 0.5]} for kind in tuning.RESPONSES}
    rows = [loop | answers | {"delay": 0.01 * k} for loop in loops for k in range(count)]
    drawn = tuning.figure({"frequency": [1.0, 10.0], "responses": rows})
    lines = drawn.axes[0].lines[:: len(tuning.RESPONSES)]
    assert len({to_hex(line.get_color()) for line in lines}) == count
    shown = drawn.legends[0]
    entries = dict(zip([text.get_text() for text in shown.get_texts()], shown.legend_handles, strict=True))
    for k, line in enumerate(lines):
        assert to_hex(entries[f"{10 * k} ms"].get_color()) == to_hex(line.get_color())
