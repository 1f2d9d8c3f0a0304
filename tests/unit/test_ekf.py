"""The extended Kalman filter against a textbook's, written with dense matrices, and against what it should not do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl.physics.plant import PLANT
from mrctl.sensing import ekf as laws
from mrctl.sensing.ekf import EKF, FIX_GATE, LOST_FIXES
from mrctl.sensing.estimators import GEOMETRY, Estimator
from mrctl.sensing.prediction import SEEN, wrapped
from mrctl.sensing.sensors import SAMPLE, SENSOR, Sensors
from mrctl.sensing.tiers import Sensing
from mrctl.theory.robot import Tyres

N = laws.N
X, Y, THETA, V, OMEGA, BIAS, OFFSET, LEFT, RIGHT, SCALE_LEFT, SCALE_RIGHT = range(N)
T, SKEW = 0.01, 0.001
RADIUS, HALF, AHEAD = 0.098, 0.188, 0.1
LAG, LOAD = 0.3e-3, 2e-4  # of the tyres
CAR = np.array([(RADIUS, HALF, AHEAD, SKEW, LAG, LOAD)], GEOMETRY)[0]
MIDDLE = T / 2 + SKEW  # velocities are half a physics step behind positions


# -- the filter of a textbook ------------------------------------------------------------------------------------------


def motion(x, force, theta_dot_dot, growth):
    """Returns the state a period later, from the equations in the filter's documentation, by the midpoint rule."""
    acceleration = force - x[OFFSET]
    v, omega = x[V] + acceleration * MIDDLE, x[OMEGA] + theta_dot_dot * MIDDLE
    # The rear axle moves along θ − c θ̇.
    heading = x[THETA] + omega * T / 2 - laws.SIDE_SLIP_TIME * omega
    new = np.array(x, np.result_type(x, force))
    new[X] += T * v * np.cos(heading)
    new[Y] += T * v * np.sin(heading)
    new[THETA] += T * omega
    new[V] += T * acceleration
    new[OMEGA] += T * theta_dot_dot
    for wheel, scale, side in ((LEFT, SCALE_LEFT, -1), (RIGHT, SCALE_RIGHT, 1)):
        speed = v + side * HALF * omega - LAG * (acceleration + side * HALF * theta_dot_dot)
        new[wheel] += T * speed / (RADIUS * (1 + x[scale] - side * growth))
    return new


def jacobian(f, x):
    """Returns ∂f/∂x to rounding, with complex steps."""
    columns = [f(x.astype(complex) + 1e-30j * np.eye(len(x))[j]).imag / 1e-30 for j in range(len(x))]
    return np.stack(columns, axis=1)


def process_noise(x, grip, s, force, theta_dot_dot, growth, jolt):
    """Returns the covariance that a period adds."""
    omega = x[OMEGA] + theta_dot_dot * MIDDLE
    heading = x[THETA] + omega * T / 2 - laws.SIDE_SLIP_TIME * omega
    across = np.array([-np.sin(heading), np.cos(heading)])
    Q = np.zeros((N, N))
    Q[:2, :2] = T * (laws.SIDE_SLIP if grip.all() else laws.SKID) ** 2 * np.outer(across, across)
    Q[V, V] = 0 if grip.any() else T * laws.SLIPPING_NOISE**2
    inputs = jacobian(lambda u: motion(x, u[0], u[1], growth), np.array([force, theta_dot_dot]))
    Q += inputs @ np.diag([s["acceleration_variance"], laws.YAW_NOISE**2 / T]) @ inputs.T
    Q[BIAS, BIAS] = T * s["bias_walk"] ** 2
    Q[OFFSET, OFFSET] = T * (s["offset_walk"] ** 2 + (s["offset"] - x[OFFSET]) ** 2 / laws.OFFSET_SETTLING)
    for wheel, scale in ((LEFT, SCALE_LEFT), (RIGHT, SCALE_RIGHT)):
        Q[wheel, wheel] += (laws.JOLT_SLIP * jolt) ** 2 + (
            T * (laws.SLIDE_NOISE / RADIUS) ** 2 if grip.sum() == 1 else 0
        )
        Q[scale, scale] = T * laws.RADIUS_WALK**2
    return Q


def joseph(x, P, residual, H, R):
    """Updates by a measurement, with the covariance in Joseph's form, which holds for any gain."""
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    rest = np.eye(N) - gain @ H
    return x + gain @ residual, rest @ P @ rest.T + gain @ R @ gain.T


def textbook(s, sample, before, theta_dot_dot, loading):
    """Returns mean and covariance of one step of the filter: prediction, encoders, gyro."""
    x, P, grip = s["mean"].copy(), s["P"].copy(), sample["grip"] == 1
    if not grip.any():  # nothing shows the offset, which is known afresh
        P[OFFSET], P[:, OFFSET] = 0, 0
        x[OFFSET], P[OFFSET, OFFSET] = s["offset"], laws.START_OFFSET**2
    force, growth = sample["acceleration"][0] + AHEAD * x[OMEGA] ** 2, LOAD * sample["acceleration"][1]
    F = jacobian(lambda z: motion(z, force, theta_dot_dot, growth), x)
    jump = abs(sample["acceleration"][0] - before["acceleration"][0])
    jolt = max(0, jump - laws.JUMP_SIGMAS * np.sqrt(2 * s["acceleration_variance"]))
    Q = process_noise(x, grip, s, force, theta_dot_dot, growth, max(jolt, laws.LOADING_JOLT) if loading else jolt)
    x, P = motion(x, force, theta_dot_dot, growth), F @ P @ F.T + Q
    for scale in SCALE_LEFT, SCALE_RIGHT:
        P[scale, scale] = max(P[scale, scale], sample["doubt"] ** 2)
    for k, wheel in enumerate((LEFT, RIGHT)):
        if not grip[k]:  # the angle of a wheel that slips says nothing of the robot, and is known afresh
            P[wheel], P[:, wheel] = 0, 0
            x[wheel], P[wheel, wheel] = sample["encoder"][k], s["encoder_variance"]
    for k, wheel in enumerate((LEFT, RIGHT)):
        if grip[k]:
            e, R = sample["encoder"][k] - x[wheel], s["encoder_variance"]
            P[wheel, wheel] = max(P[wheel, wheel], e**2 / laws.SLIP_SIGMAS**2 - R)  # the slip is in the angle
            x, P = joseph(x, P, np.array([e]), np.eye(N)[[wheel]], np.array([[R]]))
    gyro = np.eye(N)[[OMEGA]] + np.eye(N)[[BIAS]]
    return joseph(x, P, sample["gyro"] - gyro @ x, gyro, np.array([[s["gyro_variance"]]]))


def random_filter(seed, spread=1.0):
    """Returns a filter in a random state, with a covariance of full rank on the scales of a run in the tier `lab`."""
    rng = np.random.default_rng(seed)
    s = np.zeros(1, EKF)[0]
    scale = spread * np.array([3e-3, 3e-3, 3e-3, 5e-3, 1e-2, 2e-3, 5e-2, 1e-4, 1e-4, 5e-3, 5e-3])
    mixed = rng.normal(size=(N, N))
    P = mixed @ mixed.T / N + 0.3 * np.eye(N)
    s["P"] = P * np.outer(scale, scale)
    s["mean"] = rng.normal(size=N) * [1, 1, 1, 0.8, 1, 2e-3, 0.1, 50, 50, 5e-3, 5e-3]
    s["encoder_variance"], s["gyro_variance"] = (2 * np.pi / 88_064) ** 2 / 12, 3e-3**2
    s["bias_walk"], s["acceleration_variance"], s["offset_walk"] = 2e-5, 0.016**2, 0.02
    s["fix_variance"], s["offset"] = (9e-6, 9e-6, 9e-6), 0.05
    s["drift_bound"] = laws.DRIFT_SIGMAS / np.sqrt(2 * laws.INNOVATION_FIXES - 1)
    s["kept_tick"] = -1
    return s, rng


def sample_of(s, rng, grip=(1, 1)):
    sample = np.zeros(1, SAMPLE)[0]
    sample["encoder"] = s["mean"][[LEFT, RIGHT]] + rng.normal(size=2) * 1e-2
    sample["gyro"], sample["acceleration"] = s["mean"][OMEGA] + rng.normal() * 0.01, rng.normal(size=2)
    sample["encoder_new"] = sample["gyro_new"] = True
    sample["grip"] = grip
    sample["doubt"] = rng.choice([0.0, 0.03])
    return sample


def ring_of(*samples):
    ring = np.zeros((len(samples), 1), SAMPLE)
    for k, sample in enumerate(samples):
        ring[k, 0] = sample
    return ring


def near(found, expected, scale, tolerance=1e-9):
    """Equality relative to a scale for each element."""
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=tolerance)


@given(st.integers(0, 10**6), st.sampled_from([(1, 1), (0, 1), (1, 0), (0, 0)]), st.floats(-6, 6), st.booleans())
def test_step(seed, grip, theta_dot_dot, loading):
    """One step is that of the textbook, whichever wheels grip."""
    s, rng = random_filter(seed)
    now, before = sample_of(s, rng, grip), np.zeros(1, SAMPLE)[0]
    before["command"], before["acceleration"] = (0.0, theta_dot_dot), rng.normal(size=2)
    mean, P = textbook(s, now, before, theta_dot_dot, loading)
    laws.step(1, ring_of(before, now), 0, CAR, T, 0, 0 if loading else -20, s)
    deviation = np.sqrt(np.diag(P))
    near(s["mean"], mean, np.maximum(deviation, np.abs(mean)))
    near(s["P"], P, np.outer(deviation, deviation))


@given(st.integers(0, 10**6))
def test_fix(seed):
    """A fix is the textbook's update by all three of its numbers at once, and its innovation has the right length."""
    s, rng = random_filter(seed)
    R, H = np.diag(s["fix_variance"]), np.eye(N)[:3]
    S = H @ s["P"] @ H.T + R
    residual = 0.7 * np.linalg.cholesky(S) @ rng.normal(size=3)
    fix = s["mean"][:3] + residual
    fix[2] = wrapped(fix[2])
    mean, P = joseph(s["mean"].copy(), s["P"].copy(), residual, H, R)
    length = residual @ np.linalg.solve(S, residual)
    laws.absorb_fix(fix, s)
    assert s["nis"] == pytest.approx(length, rel=1e-9)
    if length < FIX_GATE:
        deviation = np.sqrt(np.diag(P))
        near(s["mean"], mean, np.maximum(deviation, np.abs(mean)))
        near(s["P"], P, np.outer(deviation, deviation))


@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-6, 6))
def test_jacobian(seed, v_dot, omega_dot):
    """`propagate` moves the covariance by the derivative of how it moves the mean."""
    s, _ = random_filter(seed)
    grip = np.ones(2, np.uint8)

    def moved(mean):
        other = s.copy()
        other["mean"] = mean
        laws.propagate(v_dot - (mean[OFFSET] - s["mean"][OFFSET]), omega_dot, 1e-3, 0.3, grip, CAR, T, other)
        return other["mean"]

    scale = np.array([1, 1, 1, 1, 1, 1, 1, 10, 10, 1, 1]) * 1e-5
    F = np.stack([(moved(s["mean"] + h) - moved(s["mean"] - h)) / 2 / h.sum() for h in np.diag(scale)], axis=1)
    P = s["P"].copy()
    quiet = s.copy()
    quiet["P"] = 0
    laws.propagate(v_dot, omega_dot, 1e-3, 0.3, grip, CAR, T, s)
    laws.propagate(v_dot, omega_dot, 1e-3, 0.3, grip, CAR, T, quiet)  # leaves Q
    expected = F @ P @ F.T
    deviation = np.sqrt(np.diag(expected))
    near(s["P"] - quiet["P"], expected, np.outer(deviation, deviation), 1e-6)


# -- streams of samples ------------------------------------------------------------------------------------------------


class Drive:
    """A robot on a smooth course, seen by sensors, and filters that are shown the samples."""

    def __init__(self, sensing, seed=0, skew=0.0):
        self.plant = np.zeros(len(sensing), PLANT)
        self.sensors = Sensors(sensing, [seed] * len(sensing), T)
        robot = type("Robot", (), {"wheel_radius": RADIUS, "half_track": HALF})()
        self.filters = Estimator("ekf", sensing, robot, self.sensors, np.array([AHEAD, 0, 0]), skew, Tyres())
        self.tick = 0
        self.state = np.array([0.0, 0.0, 0.3])
        self.angles = np.array([0.2, 0.1])
        self._read()
        for row in range(len(sensing)):
            self.filters.start(row, self.plant["reading"][row], seed, 0)

    def twist(self, t):
        return 0.6 + 0.3 * np.sin(1.1 * t), np.sin(0.7 * t), 0.33 * np.cos(1.1 * t), 0.7 * np.cos(0.7 * t)

    def _read(self):
        v, omega, v_dot, _ = self.twist(self.tick * T)
        reading = self.plant["reading"]
        reading["pose"], reading["twist"] = self.state, (v, omega)
        reading["wheel_rates"] = (v - HALF * omega) / RADIUS, (v + HALF * omega) / RADIUS
        self.plant["wheel_angles"] = self.angles
        self.plant["specific_force"] = self.twist((self.tick - 0.5) * T)[2] - AHEAD * omega**2, v * omega

    def step(self):
        """Measures and estimates, then drives on for a period along v_y = −c V θ̇."""
        self._read()
        self.sensors.measure(self.tick, self.plant)
        self.filters.estimate(self.tick, self.plant)
        self.sensors.command(self.tick, np.tile(self.twist((self.tick + 0.5) * T)[2:], (len(self.plant), 1)))
        for k in range(10):
            v, omega, _, _ = self.twist((self.tick + (k + 0.5) / 10) * T)
            direction = self.state[2] + omega * T / 20 - laws.SIDE_SLIP_TIME * omega
            self.state = self.state + T / 10 * np.array([v * np.cos(direction), v * np.sin(direction), omega])
            self.angles = self.angles + T / 10 * np.array([v - HALF * omega, v + HALF * omega]) / RADIUS
        self.tick += 1


@given(
    st.integers(0, 10**6), st.floats(-0.05, 0.05), st.floats(0.1, 1.0), st.booleans(),
    st.sampled_from([(1, 1), (1, 5), (1, 20), (4, 1), (4, 20)]),
)  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_another_radius(seed, difference, speed, calm, every):
    """The radii are doubted when the mean difference, a decaying exponential, leaves its band, and only in calm.

    The noise of a gyro sample counts as often as the encoders are read before the next one; in between θ̇ changes.
    """
    sensor, gap, repeats = np.zeros(1, SENSOR)[0], T * every[0], max(1, every[1] / every[0])
    sensor["encoder_every"], sensor["gyro_every"] = every
    s, rng = random_filter(seed)
    s["inertial"] = speed
    sample = sample_of(s, rng)
    sample["acceleration"], sample["doubt"] = (s["offset"] + (0.0 if calm else 1.01 * laws.CALM_ACCELERATION), 0), 0
    counts = 2 * s["encoder_variance"] * (RADIUS / laws.RADIUS_AVERAGE) ** 2
    turning = (2 * HALF) ** 2 * s["gyro_variance"] * repeats * gap / (2 * laws.RADIUS_AVERAGE)
    slope = np.zeros(N)  # of the difference by the state
    slope[[BIAS, SCALE_LEFT, SCALE_RIGHT]] = -2 * HALF, speed, -speed
    band = 4 * np.sqrt(counts + turning + slope @ s["P"] @ slope) + laws.GRIP_DIFFERENCE
    band += 2 * HALF * laws.HELD_NOISE[1] * T * (every[1] - 1)
    means = difference * (1 - (1 - gap / laws.RADIUS_AVERAGE) ** np.arange(1, 501))
    expected = np.flatnonzero(abs(means) > band)[:1]
    found = None
    for n in range(500):
        laws.find_radius(difference, sample, CAR, gap, sensor, s)
        if sample["doubt"] > 0:
            found = n
            break
    assert (found is not None) == (calm and len(expected) > 0)
    if found is not None:
        assert found == expected[0] and sample["doubt"] == pytest.approx(
            min(abs(means[found]) / speed, laws.RADIUS_DOUBT)
        )
        assert s["difference"] == 0


@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=25, deadline=None)
def test_drift(seed, along, turned):
    """Radii, bias and posture are doubted when a mean innovation, a decaying exponential, leaves its band."""
    s, _ = random_filter(seed)
    s["bias_variance"] = 2 * s["P"][BIAS, BIAS]
    means = np.outer((along, turned), 1 - (1 - 1 / laws.INNOVATION_FIXES) ** np.arange(1, 201))
    expected = np.flatnonzero(abs(means).max(0) > laws.DRIFT_SIGMAS / np.sqrt(2 * laws.INNOVATION_FIXES - 1))[:1]
    before, found = s.copy(), None
    for n in range(200):
        laws.find_drift(along, turned, s)
        if not np.array_equal(s["P"], before["P"]):
            found = n
            break
    assert [found] == (list(expected) or [None])
    assert np.array_equal(s["mean"], before["mean"])
    if found is None:
        np.testing.assert_allclose(s["drift"], means[:, -1], rtol=1e-9, atol=1e-12)
        return
    assert np.all(s["drift"] == 0)
    raised = np.diag(s["P"] - before["P"]).copy()
    np.testing.assert_allclose(raised[:3], s["fix_variance"], rtol=1e-9)
    assert np.diag(s["P"])[[BIAS, SCALE_LEFT, SCALE_RIGHT]] == pytest.approx(
        [2 * before["P"][BIAS, BIAS], *np.maximum(laws.RADIUS_DOUBT**2, np.diag(before["P"])[-2:])]
    )
    raised[[0, 1, 2, BIAS, SCALE_LEFT, SCALE_RIGHT]] = 0
    assert not raised.any() and np.array_equal(np.triu(s["P"], 1), np.triu(before["P"], 1))


@given(st.integers(0, 10**6), st.floats(-np.pi, np.pi), st.floats(-0.9, 0.9))
def test_drift_along_the_heading(seed, heading, correlation):
    """A fix adds to the running means hᵀe/√(hᵀSh)/n for the directions h along the heading and of the heading."""
    s, rng = random_filter(seed)
    s["mean"][THETA] = heading
    deviation = np.array([0.05, 0.01])
    P = np.diag(np.diag(s["P"]))
    P[:2, :2] = np.outer(deviation, deviation) * [[1, correlation], [correlation, 1]]
    s["P"][:] = P
    S = P[:3, :3] + np.diag(s["fix_variance"])
    e = 0.3 * np.linalg.cholesky(S) @ rng.normal(size=3)
    directions = np.array([[np.cos(heading), np.sin(heading), 0], [0, 0, 1]])
    expected = [h @ e / np.sqrt(h @ S @ h) / laws.INNOVATION_FIXES for h in directions]
    laws.absorb_fix(s["mean"][:3] + e, s)
    np.testing.assert_allclose(s["drift"], expected, rtol=1e-6, atol=1e-12)


def test_drift_of_innovations():
    """The running mean of innovations that the filter's own covariance expects has the variance 1/(2n − 1)."""
    s, rng = random_filter(5)
    S = s["P"][:3, :3] + np.diag(s["fix_variance"])
    root, drift, kept = np.linalg.cholesky(S), np.zeros(2), []
    for e in (root @ rng.normal(size=(3, 20_000))).T:
        other = s.copy()
        other["drift"] = drift
        laws.absorb_fix(s["mean"][:3] + e, other)
        if other["nis"] <= FIX_GATE:
            drift = other["drift"].copy()
            kept.append(drift)
    variance = np.var(kept, axis=0) * (2 * laws.INNOVATION_FIXES - 1)
    assert variance == pytest.approx([1, 1], abs=0.2)


def lab(**values):
    return Sensing(tier="lab", delay=0.0, **values)


@given(st.integers(0, 10**6), st.integers(0, 20))
@settings(max_examples=20)
def test_covariance_after_the_latency(seed, count):
    """It is F P Fᵀ and the accelerations by which predictions miss, with F of one step over the whole latency."""
    s, rng = random_filter(seed)
    s["missed"] = rng.uniform(0, 1e-2, 2)
    seen, L = np.zeros(1, SEEN)[0], count * T

    def step(x, v_dot, omega_dot):
        v, omega = x[V] + v_dot * L / 2, x[OMEGA] + omega_dot * L / 2
        heading = x[THETA] + omega * L / 2
        return np.array([
            x[X] + L * v * np.cos(heading), x[Y] + L * v * np.sin(heading), x[THETA] + L * omega, x[V] + L * v_dot,
            x[OMEGA] + L * omega_dot,
        ])  # fmt: skip

    x, P = s["mean"][:5].copy(), s["P"][:5, :5].copy()
    after = step(x, 0.0, 0.0)
    seen["pose"], seen["twist"] = after[:3], after[3:]
    F = jacobian(lambda z: step(z, 0.0, 0.0), x)
    expected = F @ P @ F.T
    if count:
        G = jacobian(lambda u: step(x, u[0] / L, u[1] / L), np.zeros(2))
        expected += G @ np.diag(s["missed"]) @ G.T
    laws.predict_covariance(count, T, s, seen)
    np.testing.assert_allclose(s["ahead"], expected, rtol=1e-9, atol=1e-15)


def test_late_fix():
    """A fix of 80 ms ago leaves the filter where the same fix would, had it come at once.

    They differ by up to a hundredth of a deviation, as the observer that finds slip is not taken back.
    """
    drive = Drive([lab(fix_rate=10, fix_latency=0.08), lab(fix_rate=10, fix_latency=0.0)])
    memory = drive.filters.memory
    for tick in range(300):
        drive.step()
        if tick < 100:
            continue
        if tick % 10 in (8, 9):
            deviation = np.sqrt(np.diag(memory["P"][1]))
            near(memory["mean"][0], memory["mean"][1], deviation, 0.01)
            near(memory["P"][0], memory["P"][1], np.outer(deviation, deviation), 0.01)
        else:
            assert not np.allclose(memory["P"][0], memory["P"][1], rtol=0.01)


class Hurry(Drive):
    """A robot that accelerates and brakes hard."""

    def twist(self, t):
        return 0.6 + 0.5 * np.sin(3 * t), np.sin(0.7 * t), 1.5 * np.cos(3 * t), 0.7 * np.cos(0.7 * t)


@pytest.mark.parametrize("counts", [0, 4000])
@pytest.mark.parametrize("rate", [50, 10, 5, 2])
def test_slow_encoders(rate, counts):
    """Wheels that grip are found to grip, and V stays within its deviation, however seldom the encoders are read.

    A rate that is as old as the last sample, or the mean since the one before, differs from V of now by up to V̇/rate.
    """
    drive, errors, slipped = Hurry([lab(encoder_rate=rate, encoder_counts=counts)]), [], 0
    for tick in range(600):
        drive.step()
        slipped += (drive.sensors.ring[tick % len(drive.sensors.ring), 0]["grip"] != 1).any()
        memory = drive.filters.memory[0]
        errors.append((memory["mean"][V] - drive.plant["reading"]["twist"][0, 0]) / np.sqrt(memory["P"][V, V]))
    assert slipped == 0
    assert np.sqrt(np.mean(np.square(errors))) < 2


def test_several_fixes_on_their_way():
    """So do fixes that are older than the time between two of them, of which four are on their way."""
    drive = Drive([lab(fix_rate=20, fix_latency=0.2), lab(fix_rate=20, fix_latency=0.0)])
    late, prompt = [], []
    for _ in range(300):
        drive.step()
        late.append(drive.filters.memory["nis"][0])
        prompt.append(drive.filters.memory["nis"][1])
    np.testing.assert_allclose(late[60:], prompt[40:-20], rtol=1e-2)


@given(st.integers(0, 10**6), st.sampled_from(["lab", "field"]), st.floats(0, 0.5), st.floats(0, 0.5))
@settings(max_examples=10)
def test_positive_definite(seed, tier, lost, outliers):
    """The covariance stays symmetric and positive definite, whatever the wheels and the fixes do."""
    rng = np.random.default_rng(seed)
    drive = Drive([Sensing(tier=tier, fix_lost=lost, fix_outliers=outliers)], seed)
    for tick in range(300):
        if tick % 40 == 0:
            slip = rng.normal(0, 0.05, 2) * rng.integers(0, 2, 2)
        drive.angles = drive.angles + slip
        drive.step()
        P = drive.filters.memory["P"][0]
        np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-9 * np.sqrt(np.outer(np.diag(P), np.diag(P))).max())
        deviation = np.sqrt(np.diag(P))
        assert np.linalg.eigvalsh(P / np.outer(deviation, deviation)).min() > 1e-9


# -- the gate ----------------------------------------------------------------------------------------------------------


def test_outlier():
    """A fix that is wrong by half a metre moves nothing; the tenth in a row is believed."""
    s, _ = random_filter(1)
    where = s["mean"][:3].copy()
    fix = where + (0.4, -0.3, 0.1)
    before = s.copy()
    for k in range(1, LOST_FIXES):
        laws.absorb_fix(fix, s)
        assert s["refused"] == k and s["nis"] > FIX_GATE
        assert np.array_equal(s["mean"], before["mean"]) and np.array_equal(s["P"], before["P"])
    laws.absorb_fix(fix, s)
    assert s["refused"] == 0
    np.testing.assert_allclose(s["mean"][:3], fix, atol=1e-3)
    np.testing.assert_allclose(np.diag(s["P"])[:3], s["fix_variance"], rtol=0.01)
    assert np.all(s["drift"] == 0)
    assert np.all(
        np.diag(s["P"])[[BIAS, SCALE_LEFT, SCALE_RIGHT]] <= np.diag(before["P"])[[BIAS, SCALE_LEFT, SCALE_RIGHT]]
    )


def test_one_good_fix_between_outliers():
    """Only refusals in a row count."""
    s, _ = random_filter(2)
    good, bad = s["mean"][:3].copy(), s["mean"][:3] + 0.5
    for _ in range(3):
        for _ in range(LOST_FIXES - 1):
            laws.absorb_fix(bad, s)
        assert s["refused"] == LOST_FIXES - 1
        laws.absorb_fix(good, s)
        assert s["refused"] == 0
    np.testing.assert_allclose(s["mean"][:3], good, atol=1e-12)


def test_gate_is_of_chi_square():
    """Of the fixes that the filter's own covariance expects, one in a thousand is refused."""
    s, rng = random_filter(3)
    S = s["P"][:3, :3] + np.diag(s["fix_variance"])
    root, refused, count = np.linalg.cholesky(S), 0, 20_000
    for e in rng.normal(size=(count, 3)):
        other = s.copy()
        laws.absorb_fix(s["mean"][:3] + root @ e, other)
        refused += other["refused"]
    assert refused == pytest.approx(count / 1000, abs=4 * np.sqrt(count / 1000))


@given(st.floats(-50, 50))
def test_wrapped(angle):
    """An angle is wrapped into (−π, π] by whole turns."""
    found = wrapped(angle)
    assert -np.pi < found <= np.pi
    turns = (angle - found) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


def test_heading_across_the_cut():
    """A fix on the other side of ±π corrects by the short way."""
    s, _ = random_filter(4)
    s["mean"][THETA] = 3.1415
    fix = np.array([*s["mean"][:2], -3.1415])
    laws.absorb_fix(fix, s)
    assert s["refused"] == 0 and 3.1415 < s["mean"][THETA] < 2 * np.pi - 3.1415
    s["mean"][THETA] = 3.1415 + 6 * np.pi  # the filter's heading goes on growing
    s["P"][:] = np.diag(np.diag(s["P"]))
    laws.absorb_fix(fix, s)
    assert s["refused"] == 0 and 3.1415 < s["mean"][THETA] - 6 * np.pi < 2 * np.pi - 3.1415
