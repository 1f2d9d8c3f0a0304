"""A robot that stands on the ground of a world touches it with its wheels, and rolls without slip."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrctl.physics import mjcf
from mrctl.physics.parameters import read_robot
from mrctl.physics.perturb import perturb
from mrctl.physics.stand import stand
from mrctl.record import InputError
from mrctl.theory.kinematics import scrub_free_angle
from mrctl.theory.perturbation import Perturbation

WORLDS = {world: mjcf.load(world) for world in ("flat", "slope", "rough", "patch")}
BASE = read_robot(WORLDS["flat"])
WHEELS = ("wheel_left", "wheel_right", "front_wheel")


def gaps(model, state):
    """Returns the signed distance of each wheel from the ground in m, from the engine's own collision."""
    loose = mjcf.clone(model)
    loose.pair_margin[:] = 0.1
    data = mujoco.MjData(loose)
    data.qpos[:] = state.qpos
    mujoco.mj_forward(loose, data)
    found = {wheel: np.inf for wheel in WHEELS}
    for contact in data.contact:
        for geom in contact.geom:
            name = loose.geom(geom).name
            if name in found:
                found[name] = min(found[name], contact.dist)
    return np.array(list(found.values()))


def with_radii(nominal, left, right):
    """Returns a copy of a model with rear wheels of these radii, as factors of the nominal ones."""
    model = mjcf.clone(nominal)
    perturb(nominal, model, Perturbation(left_radius_factor=left, right_radius_factor=right))
    return model


def heading(state):
    """Returns the heading of the body's x axis in rad."""
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, state.qpos[3:7])
    return math.atan2(frame[3], frame[0])


@pytest.mark.parametrize("radii", [(1.0, 1.0), (1.05, 0.97)])
@pytest.mark.parametrize("world", ["flat", "slope", "patch"])
@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(0.1, 1), st.floats(-1, 1))
@settings(max_examples=8)
def test_stands_on_planes(world, radii, x, y, theta, v, omega):
    """On a plane three wheels of any radii touch to a nanometre, at the requested pose."""
    model = with_radii(WORLDS[world], *radii)
    state = stand(model, np.array([x, y, theta]), np.array([v, omega]))
    assert gaps(model, state) == pytest.approx(0, abs=1e-9)
    assert tuple(state.qpos[:2]) == (x, y)
    assert math.remainder(heading(state) - theta, 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1))
@settings(max_examples=30)
def test_stands_on_bumps(x, y, theta):
    """On uneven ground no wheel penetrates, one touches, and the others are no higher than the bumps."""
    state = stand(WORLDS["rough"], np.array([x, y, theta]), np.array([0.5, 0.0]))
    gap = gaps(WORLDS["rough"], state)
    assert gap.min() > -1e-6 and gap.min() < 2e-3 and gap.max() < 0.01
    assert math.remainder(heading(state) - theta, 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(st.floats(0, 1.5), st.floats(-2, 2), st.floats(0.9, 1.1), st.floats(0.9, 1.1))
@settings(max_examples=30)
def test_rolls(v, omega, left, right):
    """The wheels have the rates of equation (1) with their own radii, and the front wheel does not scrub."""
    model = with_radii(WORLDS["flat"], left, right)
    state = stand(model, np.zeros(3), np.array([v, omega]))
    steering = state.qpos[model.joint("steering").qposadr[0]]
    free = float(scrub_free_angle(np.array([v, omega]), BASE))
    assert steering == pytest.approx(np.clip(free, -BASE.steering_limit, BASE.steering_limit))
    front = math.cos(steering) * v + BASE.wheelbase * math.sin(steering) * omega
    expected = ((v - 0.188 * omega) / (0.098 * left), (v + 0.188 * omega) / (0.098 * right), front / 0.075)
    for wheel, rate in zip(WHEELS, expected, strict=True):
        assert state.qvel[model.joint(wheel).dofadr[0]] == pytest.approx(rate, abs=1e-9)
    # No rear contact point slides along the body's x axis, by the engine's own Jacobian.
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state
    mujoco.mj_forward(model, data)
    assert np.linalg.norm(data.qvel[:3]) == pytest.approx(v) and data.qvel[5] == omega
    for wheel in ("wheel_left", "wheel_right"):
        jacobian = np.zeros((3, model.nv))
        point = data.geom(wheel).xpos - model.geom(wheel).size[0] * data.body("chassis").xmat.reshape(3, 3)[:, 2]
        mujoco.mj_jac(model, data, jacobian, None, point, model.body(wheel).id)
        assert data.body("chassis").xmat.reshape(3, 3)[:, 0] @ jacobian @ data.qvel == pytest.approx(0, abs=1e-9)


def test_no_ground():
    """A pose beyond the edge of the height field is refused."""
    with pytest.raises(InputError, match=r"^initial_pose: there is no ground below \(20\.\d\d, "):
        stand(WORLDS["rough"], np.array([20.0, 0.0, 0.0]), np.zeros(2))
