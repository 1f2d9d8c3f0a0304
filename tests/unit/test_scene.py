"""What the viewer draws itself: ribbons on the ground, and ghosts with few corners."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mjviser.conversions import merge_geoms

from mrctl.physics import mjcf
from mrctl.theory.robot import CAR, RobotFile
from mrctl.viewer.robots import LAST_VISIBLE_GROUP, _rough
from mrctl.viewer.shapes import ribbons


def test_ribbon_of_a_circle():
    """A closed ribbon around a circle is the ring between two circles, level and facing up."""
    turn = np.linspace(0, 2 * np.pi, 801)
    circle = np.stack([np.cos(turn), np.sin(turn), np.full(801, 0.3)], axis=-1)
    vertices, faces = ribbons(np.stack([circle, 2 * circle + [5, 0, 0]]), 0.1)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.area == pytest.approx(2 * np.pi * 0.1 * (1 + 2), rel=1e-3)
    assert (mesh.face_normals @ [0, 0, 1] > 0.999).all()
    radius = np.hypot(*vertices[: 2 * 801, :2].T)
    assert sorted({*np.round(radius, 3)}) == pytest.approx([0.95, 1.05])
    assert mesh.bounds[:, 2] == pytest.approx([0.3, 0.6])


@given(arrays(float, (2, 5, 3), elements=st.floats(-10, 10)))
def test_ribbon_of_anything(lines):
    """A robot that stands or comes back the way it went leaves no hole in the data, and lines stay apart."""
    vertices, faces = ribbons(lines, 0.02)
    assert np.isfinite(vertices).all()
    pairs = vertices.reshape(2, 5, 2, 3)
    np.testing.assert_allclose(pairs.mean(axis=2), lines, atol=1e-5)
    assert (np.linalg.norm(pairs[:, :, 1] - pairs[:, :, 0], axis=-1) <= 0.02 + 1e-5).all()
    assert faces.shape == (16, 3) and ((faces < 10) == (faces < 10)[:, :1]).all()


@pytest.mark.parametrize(("robot", "steering"), [("", "compliant"), ("turtlebot", "caster"), ("racecar", "rigid")])
def test_ghosts(robot, steering):
    """A ghost has the size and nearly the volume of its robot, from a fraction of the triangles where that is round."""
    model = mjcf.load("flat", steering, robot=RobotFile(path=robot) if robot else CAR)
    bodies = {int(b) for b in model.geom_bodyid} - {0}
    counts = np.zeros(2)
    for body in bodies:
        geoms = [
            g for g in range(model.ngeom)
            if model.geom_bodyid[g] == body and model.geom_group[g] <= LAST_VISIBLE_GROUP and model.geom_rgba[g, 3] > 0
        ]  # fmt: skip
        if geoms:
            fine, rough = merge_geoms(model, geoms), _rough(model, geoms)
            np.testing.assert_allclose(rough.bounds, fine.bounds, atol=0.01)
            assert rough.volume == pytest.approx(fine.volume, rel=0.1)
            counts += len(fine.faces), len(rough.faces)
    assert counts[1] < counts[0]
