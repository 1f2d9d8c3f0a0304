"""Angles and frames against complex numbers, where a rotation by θ is a multiplication by exp(iθ)."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mrctl.angles import body_to_world, world_to_body, wrap

angles = st.floats(-1e4, 1e4)
coordinates = st.floats(-1e3, 1e3)


@given(angles)
@example(np.pi)
@example(-np.pi)
@example(float(np.nextafter(np.pi, 4)))  # the mod of a tiny negative number rounds up to the modulus itself
@example(float(np.nextafter(-np.pi, -4)))
@example(-0.0)
def test_wrap_range(angle):
    """Never −π, never beyond π."""
    assert -np.pi < wrap(angle) <= np.pi


@given(angles)
def test_wrap_same_direction(angle):
    """The wrapped angle points where the angle points."""
    assert np.exp(1j * wrap(angle)) == pytest.approx(np.exp(1j * angle), abs=1e-11)


def test_wrap_known():
    """Both ends of the interval, whole turns, and arrays keep their shape."""
    wrapped = wrap([[np.pi, -np.pi, 3 * np.pi], [0, 2 * np.pi, -1.5 * np.pi]])
    np.testing.assert_allclose(wrapped, [[np.pi, np.pi, np.pi], [0, 0, np.pi / 2]], atol=1e-14)


@given(coordinates, coordinates, angles)
def test_rotation_complex(x, y, heading):
    """The world vector of a body vector is exp(iθ) times it."""
    turned = (x + 1j * y) * np.exp(1j * heading)
    np.testing.assert_allclose(body_to_world([x, y], heading), [turned.real, turned.imag], atol=1e-9)


@given(coordinates, coordinates, angles)
def test_rotation_inverse(x, y, heading):
    """There and back again."""
    np.testing.assert_allclose(world_to_body(body_to_world([x, y], heading), heading), [x, y], atol=1e-9)


@given(angles)
def test_rotation_orthonormal(heading):
    """The rotated unit vectors stay orthonormal and right-handed."""
    axes = world_to_body(np.eye(2), heading)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_rotation_batches():
    """One heading for many vectors, and one for each, give the same rows as one by one."""
    vectors, headings = np.random.default_rng(1).normal(size=(5, 2)), np.linspace(-4, 4, 5)
    for rotate in (body_to_world, world_to_body):
        rows = [rotate(vector, heading) for vector, heading in zip(vectors, headings, strict=True)]
        np.testing.assert_array_equal(rotate(vectors, headings), rows)
        np.testing.assert_array_equal(rotate(vectors, 0.3)[2], rotate(vectors[2], 0.3))
