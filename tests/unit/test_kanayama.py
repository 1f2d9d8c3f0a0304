"""Kanayama's law against complex numbers, its Lyapunov function and its linearised line dynamics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from mrctl.control.kanayama import GAINS, kanayama, posture_error
from mrctl.kernel import over_rows
from mrctl.theory.kinematics import pose_rates

K = np.array([3.0, 25.0, 10.0])


def rows(width, bound, size=4):
    """Arrays (size, width) of numbers up to `bound`."""
    return arrays(float, (size, width), elements=st.floats(-bound, bound))


def follow(pose, reference, twist, gains):
    """Posture errors `(B, 3)` and requested twists `(B, 2)`, or those of one robot if `pose` is that of one."""
    size = len(np.atleast_2d(pose))
    poses, references, twists, k = (
        np.array(np.broadcast_to(values, (size, width)), float, order="C")
        for values, width in ((pose, 3), (reference, 3), (twist, 2), (gains, 3))
    )
    error, request = np.zeros((size, 3)), np.zeros((size, 2))
    over_rows(posture_error, poses, references, error)
    over_rows(kanayama, error, twists, k.view(GAINS)[:, 0], request)
    return (error, request) if np.ndim(pose) > 1 else (error[0], request[0])


def body_error(pose, reference):
    """(x_e, y_e, θ_e) by complex numbers."""
    along = (complex(*reference[:2]) - complex(*pose[:2])) * np.exp(-1j * pose[2])
    return np.array([along.real, along.imag, np.angle(np.exp(1j * (reference[2] - pose[2])))])


def move(pose, twist, time):
    """The ideal unicycle along the arc of a constant twist."""
    turn = twist[1] * time
    chord = twist[0] * time * np.sinc(turn / 2 / np.pi) * np.exp(1j * (pose[2] + turn / 2))
    return pose + [chord.real, chord.imag, turn]


@given(rows(3, 8.0), rows(3, 8.0), rows(2, 2.0))
def test_error(pose, reference, twist):
    """The error is R(θ)ᵀ(reference − pose), its heading the short way round."""
    error, _ = follow(pose, reference, twist, K)
    expected = np.array([body_error(p, r) for p, r in zip(pose, reference, strict=True)])
    np.testing.assert_allclose(error[:, :2], expected[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * (error[:, 2] - expected[:, 2])), 1, atol=1e-12)
    assert (np.abs(error[:, 2]) <= np.pi).all()


@given(rows(3, 2.0, 1), rows(3, 2.0, 1), rows(2, 1.5, 1), st.integers(-5, 5))
def test_full_turns(pose, reference, twist, turns):
    """Counting full turns of the heading changes nothing."""
    _, request = follow(pose, reference, twist, K)
    _, turned = follow(pose, reference + [0, 0, 2 * np.pi * turns], twist, K)
    np.testing.assert_allclose(turned, request, atol=1e-11)


def test_published_law():
    """One value by hand: a robot turned by 90° that stands 0.1 m ahead of and 0.2 m right of its reference."""
    error, request = follow([1.0, 1.0, np.pi / 2], [0.8, 0.9, np.pi / 6], [0.5, 0.3], [10.0, 64.0, 16.0])
    np.testing.assert_allclose(error, [-0.1, 0.2, -np.pi / 3], atol=1e-12)
    np.testing.assert_allclose(request, [0.5 * 0.5 - 1.0, 0.3 + 0.5 * (64 * 0.2 - 16 * np.sqrt(3) / 2)], atol=1e-12)


@given(
    rows(2, 1.0, 1), st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3),
    st.floats(0, 10), st.floats(1, 80), st.floats(0, 20),
)  # fmt: skip
def test_lyapunov(offset, turn, v, omega, k_x, k_y, k_theta):
    """½(x² + y²) + (1 − cos θ_e)/K_y falls at the rate −K_x x² − |v_r| K_θ sin²θ_e/K_y along the ideal unicycle."""
    pose, reference, target = np.array([*offset[0], turn]), np.array([0.3, -0.2, 0.4]), np.array([v, omega])
    error, request = follow(pose, reference, target, [k_x, k_y, k_theta])

    def potential(time):
        x, y, theta = body_error(move(pose, request, time), move(reference, target, time))
        return (x * x + y * y) / 2 + (1 - np.cos(theta)) / k_y

    h = 1e-5
    slope = (potential(h) - potential(-h)) / (2 * h)
    expected = -k_x * error[0] ** 2 - abs(v) * k_theta * np.sin(error[2]) ** 2 / k_y
    assert slope == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert expected <= 0


@pytest.mark.parametrize("speed", [0.3, -0.3])
@pytest.mark.parametrize("damping", [0.75, 1.0, 1.25])
def test_line(speed, damping):
    """Beside a straight line y obeys ÿ + 2ζξẏ + ξ²y = 0, ξ = |v_r| √K_y, forwards and in reverse."""
    gains, y_0 = np.array([10.0, 64.0, 16.0 * damping]), 1e-4
    frequency = abs(speed) * 8.0

    def rates(t, pose):
        _, request = follow(pose, [speed * t, 0.0, 0.0], [speed, 0.0], gains)
        return pose_rates(pose, request)

    times = np.linspace(0, 3, 13)
    path = solve_ivp(rates, (0, 3), [0, y_0, 0], t_eval=times, rtol=1e-8, atol=1e-12).y
    system = np.array([[0, 1], [-(frequency**2), -2 * damping * frequency]])
    expected = [(expm(system * t) @ [y_0, 0])[0] for t in times]
    np.testing.assert_allclose(path[1], expected, atol=1e-5 * y_0)


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_convergence(speed):
    """From far beside a circle, and badly turned, the robot comes back: forwards and in reverse."""
    target = np.array([speed, 0.4])
    pose, reference = np.array([-0.3, 0.4, 1.5]), np.array([0.0, 0.0, 0.0])
    for _ in range(2000):
        error, request = follow(pose, reference, target, K)
        pose, reference = move(pose, request, 0.01), move(reference, target, 0.01)
    assert np.abs(error).max() < 1e-6


@given(rows(3, 50.0), rows(3, 50.0))
def test_rest(pose, reference):
    """At a resting reference the request is finite, turns nothing, and vanishes on the spot."""
    error, request = follow(pose, reference, np.zeros(2), K)
    np.testing.assert_array_equal(request, np.stack([3.0 * error[:, 0], 0 * error[:, 0]], -1))
    assert np.isfinite(request).all()
    _, there = follow(pose, pose, np.zeros(2), K)
    assert not there.any()


@given(rows(3, 10.0), rows(3, 10.0), rows(2, 2.0), arrays(float, (4, 3), elements=st.floats(0, 60)))
def test_rows(pose, reference, twist, gains):
    """Robots do not mix: a row has the same bits alone and beside others, one of which is lost."""
    alone = [np.hstack(follow(*(a[i : i + 1] for a in (pose, reference, twist, gains)))) for i in range(4)]
    pose[2] = np.nan
    together = np.hstack(follow(pose, reference, twist, gains))
    for i in (0, 1, 3):
        assert together[i].tobytes() == alone[i].tobytes()
