"""What the viewer shows of missions: obstacles that move, plans and goals, clearances, scans, and goals by click."""

import numpy as np
import pytest

from mrctl import Box, Circle, Disc, Line, Obstacles, Scenario, save, simulate
from mrctl.viewer.live import Live
from mrctl.viewer.recording import Library
from mrctl.viewer.replay import Replay
from mrctl.viewer.server import Server

TURNING = Box(x=0.1, y=3.0, length=0.3, width=0.2, course=Circle(radius=0.5, period=6.0))
PASSING = Disc(y=-2.0, radius=0.2, course=Line(speed=0.5, length=4.0))
MOVING = Obstacles(shapes=(TURNING, Disc(x=3.0, y=1.5, radius=0.2), PASSING))
DRIVE = Scenario(reference=Line(speed=0.5, length=1.0), laps=1, learner="none", obstacles=MOVING)


@pytest.fixture
def server():
    server = Server(port=0)
    yield server
    server.stop()


def on_circle(time):
    """Where the box's course is, by the formula of a circle that begins at the origin along +x."""
    turn = 2 * np.pi * time / 6.0
    return 0.5 * np.sin(turn), 0.5 * (1 - np.cos(turn)), turn


def check_movers(scene, time):
    """The nodes of both obstacles that move are where their courses are, by formula."""
    (x, y, theta), (box, disc) = on_circle(time), scene._movers
    assert box.position == pytest.approx([x, y, 0], abs=1e-9)
    assert 2 * np.arctan2(box.wxyz[3], box.wxyz[0]) == pytest.approx(theta)
    assert disc.position == pytest.approx([0.5 * time, 0, 0], abs=1e-9)


def test_obstacles_move(server, tmp_path):
    """Live and in a replay they are where the physics has them, at the start and later."""
    live = Live([DRIVE], server)
    for tick in (0, 130):
        while live.session.tick < tick:
            live.session.step()
        live.draw()
        check_movers(live._scene, 0.01 * tick)
    positions, _ = live.session.simulations[0][1].plant.mocap
    assert np.allclose([m.position for m in live._scene._movers], positions[0], atol=1e-12)
    save(simulate(DRIVE), tmp_path / "result.zarr")
    replay = Replay(Library(tmp_path / "result.zarr"), [0], server)
    for time in (1.3, 0.0):
        replay._scrub(time)
        replay.draw()
        check_movers(replay._scene, time)
