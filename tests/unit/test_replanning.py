"""Plans on the way: a search that has found no way is repeated when something has changed, and not before."""

import numpy as np
import pytest

from mrctl import Disc, InputError, Obstacles, RobotFile, Scenario
from mrctl.navigation import hybrid_astar
from mrctl.navigation.avoiders import avoiding
from mrctl.navigation.hybrid_astar import NoWay
from mrctl.navigation.planning import prepared
from mrctl.navigation.replanning import Planner
from mrctl.navigation.sight import Sight
from mrctl.navigation.tasks import task_of
from mrctl.navigation.vehicle import Vehicle
from mrctl.navigation.window import Window
from mrctl.theory.obstacles import Surroundings
from mrctl.theory.references import Waypoints

WAY = Waypoints(points=((0.0, 0.0), (1.0, 0.0)), closed=False)
REST = np.zeros(2)


class Seen(Sight):
    """Sees what it is told to see: discs, x and y in m, `(k, 2)`."""

    def __init__(self, known: Obstacles) -> None:
        super().__init__(known)
        self.show()

    def show(self, *discs: tuple[float, float]) -> None:
        """Lets these be all that is seen, standing."""
        self._found = np.array([(x, y, 0.0, 0.0, 0.0) for x, y in discs]).reshape(-1, 5)
        shapes = tuple(Disc(x=x, y=y, radius=0.05) for x, y in discs)
        self.standing = Surroundings(Obstacles(shapes=shapes)).at(0.0)


class Tries:
    """Stands for the search: counts its calls, and answers as it is told to."""

    def __init__(self) -> None:
        self.count, self.answer = 0, NoWay("goal: there is no way")

    def __call__(self, *_: object) -> Waypoints | None:
        self.count += 1
        if isinstance(self.answer, NoWay):
            raise self.answer
        return self.answer


@pytest.fixture
def planner() -> Planner:
    """A planner before a disc, whose search finds no way."""
    scenario = Scenario(reference=WAY, laps=1)
    return Planner(Tries(), scenario, Seen(Obstacles(shapes=(Disc(x=3.0, radius=0.2),))), Vehicle.of(scenario))


def searches(planner: Planner, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> int:
    """Returns how often the search is asked for one plan, which there is not."""
    before = planner._replan.count
    assert planner.plan(np.array(pose), REST, 1.0) is None
    return planner._replan.count - before


def test_no_way_is_not_searched_again(planner: Planner) -> None:
    """Noise changes nothing; the robot elsewhere, an obstacle more or less, another goal or another run do."""
    planner.sight.show((1.0, 0.0))
    assert searches(planner) == 2  # with a margin, and without
    assert searches(planner) == 0
    planner.sight.show((1.01, -0.02))
    assert searches(planner, (0.01, 0.005, -0.01)) == 0
    assert searches(planner, (0.03, 0.0, 0.0)) == 2
    assert searches(planner, (0.03, 0.0, 0.1)) == 2
    planner.sight.show((1.0, 0.0), (1.0, 1.0))
    assert searches(planner, (0.03, 0.0, 0.1)) == 2
    planner.sight.show((1.0, 1.0))
    assert searches(planner, (0.03, 0.0, 0.1)) == 2
    planner.sight.show((1.0, 1.08))
    assert searches(planner, (0.03, 0.0, 0.1)) == 2
    assert planner.plan(np.array((0.03, 0.0, 0.1)), REST, 3.9) is None and searches(planner, (0.03, 0.0, 0.1)) == 0
    before = planner._replan.count
    assert planner.plan(np.array((0.03, 0.0, 0.1)), REST, 4.1) is None and planner._replan.count == before + 2
    planner.take(WAY, 0.0)
    assert searches(planner, (0.03, 0.0, 0.1)) == 2
    planner.reset()
    planner.sight.show((1.0, 1.0))
    assert searches(planner, (0.03, 0.0, 0.1)) == 2


def test_no_way_while_it_drives_on(planner: Planner) -> None:
    """A robot that drives on towards what blocks its plan does not search again until there was a way."""
    planner.sight.show((1.0, 0.0))
    assert searches(planner) == 2
    before = planner._replan.count
    assert planner.plan(np.array((0.5, 0.1, 0.2)), REST, 9.0, ahead=True) is None and planner._replan.count == before
    planner._replan.answer = WAY
    assert planner.plan(np.array((0.5, 0.1, 0.2)), REST, 9.0) is WAY
    planner._replan.answer, before = NoWay("goal: there is no way"), planner._replan.count
    assert planner.plan(np.array((0.5, 0.1, 0.2)), REST, 10.0, ahead=True) is None
    assert planner._replan.count == before + 2


def test_other_refusals_are_tried_again(planner: Planner) -> None:
    """That the robot seems to be within the margin of an obstacle may be noise, and costs no search."""
    planner._replan.answer = None
    planner.sight.show((1.0, 0.0))
    assert searches(planner) == searches(planner) == 2
    planner._replan.answer = WAY
    assert planner.plan(np.zeros(3), REST, 1.0) is WAY


def test_margin_around_nothing(planner: Planner) -> None:
    """Where nothing but the map is known, there is no margin to leave out in a second search."""
    assert searches(planner) == 1 and searches(planner) == 0


def test_no_way_is_proven_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bay that takes reversing is refused to `mppi` after a search forward, one beyond its lane, one in reverse."""
    scenario, tried = Scenario.from_dict({"robot": {"path": "turtlebot"}}), []
    task, search = task_of("parking_bay:3", scenario), hybrid_astar.search.compiled

    class Counted:
        @staticmethod
        def compiled(*arguments: object) -> object:
            tried.append(arguments[4])
            return search(*arguments)

    monkeypatch.setattr(hybrid_astar, "search", Counted)
    with pytest.raises(InputError, match="never plans in reverse"):
        prepared(task, scenario, avoid="mppi")
    assert tried == [False, False, True]


def test_turned_more_than_once() -> None:
    """A plan from a heading that has counted whole turns is that from the same heading without them."""
    own = Scenario(prior="model", learner="none")
    _, drive = prepared(task_of("doorway:3", own), own, avoid="window")
    made = avoiding("window")
    assert made is not None
    stage = made(Vehicle.of(own).robot, 1)
    stage.assign([drive])
    (planner,) = stage._planners
    pose = np.array(drive.initial_pose)
    plain, turned = (planner.plan(pose + [0, 0, turns * 2 * np.pi], REST, 0.0) for turns in (0, -3))
    assert plain is not None and turned is not None
    np.testing.assert_allclose(turned.points, plain.points, atol=1e-9)


def test_speed_of_the_way() -> None:
    """A plan to the end of a way that an event brought is as fast as that way, and not as the plan of the mission."""
    own = Scenario(prior="model", learner="none")
    _, drive = prepared(task_of("doorway:3", own), own, speed=1.0, avoid="barrier")
    made = avoiding("barrier")
    assert made is not None
    stage = made(Vehicle.of(own).robot, 1)
    stage.assign([drive])
    (planner,) = stage._planners
    x, y, theta = drive.initial_pose or (0.0, 0.0, 0.0)
    way = Waypoints(points=((x, y), (x + 1.0, y)), closed=False, timing="limits", speed=0.3)
    before = planner.plan(np.array((x, y, theta)), REST, 0.0)
    planner.take(way, 0.0)
    after = planner.plan(np.array((x, y, theta)), REST, 0.0)
    assert before is not None and before.speed == 1.0 and after is not None
    times = np.linspace(0.0, after.period, 200)
    assert after.sample(times).twist[:, 0].max() == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize(("away", "goes_back"), [(1.5, False), (20.0, True), (None, True)])
def test_goes_back_unless_something_moves_near(away: float | None, goes_back: bool) -> None:
    """A TurtleBot that cannot pass goes back the way that it came, but waits where it could meet what moves."""
    plan = Waypoints(points=((0, 0), (3, 0)), closed=False, timing="limits", speed=0.5)
    scenario = Scenario(robot=RobotFile(path="turtlebot"), reference=plan, prior="model", motion_period=0.05)
    stage = Window(Vehicle.of(scenario).robot, 1, lambda *_: None)
    stage.assign([scenario])
    pose, period, speeds = np.zeros((1, 3)), scenario.motion_period, []
    stage.reset(pose, np.zeros((1, 7)), period)
    (planner,) = stage._planners
    planner.sight = seen = Seen(Obstacles())
    seen.show(*((1.0, y / 20) for y in range(-40, 41)))  # a wall
    if away is not None:
        seen._found = np.vstack([seen._found, (-away, 0.5, 0.2, 0.0, 0.0)])
    twist = np.zeros((1, 2))
    for _ in range(round(6.0 / period)):
        planner.looked = True
        twist = stage.output(pose, twist, np.zeros((1, 7)))
        c, s = np.cos(pose[0, 2]), np.sin(pose[0, 2])
        pose = pose + period * np.array([[twist[0, 0] * c, twist[0, 0] * s, twist[0, 1]]])
        speeds.append(twist[0, 0])
        seen._found[len(seen.standing.discs) :, 4] += period  # what moves stays in its place
    assert (min(speeds) < -0.1) == goes_back and 0.4 < max(speeds)
