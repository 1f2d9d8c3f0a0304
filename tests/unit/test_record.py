"""Input from outside: it makes a valid record, or is refused with one line that names the field."""

import ast
import inspect
import math
import pydoc
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import mrctl
from mrctl.navigation.generators import Task
from mrctl.record import InputError, Record
from mrctl.scenario import Event, Scenario
from mrctl.theory.perturbation import Perturbation
from mrctl.theory.references import Circle, Line, Waypoints


class Inner(Record):
    """A record inside another."""

    rate: float


class Outer(Record):
    """A record with another one in it."""

    name: str = "x"
    inner: Inner = Inner(rate=1.0)


def write(tmp_path, text):
    """Writes a TOML file with the text."""
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    return path


def test_text_in_place_of_a_path():
    """The text of a file where its path is expected gives one line."""
    with pytest.raises(InputError, match=r"^[^\n]*name = .*: (File name too long|No such file or directory)$"):
        Outer.from_toml('name = "y"\n' * 500)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"colour": 1}, "colour"),
        ({"inner": {"rate": "fast"}}, "inner.rate"),
        ({"inner": {"rate": float("nan")}}, "inner.rate"),
        ({"inner": {"rate": float("inf")}}, "inner.rate"),
        ({"inner": {"rate": 10**400}}, "inner.rate"),
        ({"inner": {}}, "inner.rate"),
        ({"inner": {"rate": 1, "x": 1}, "name": 3}, "inner.x: there is no such field"),
        ({"two\nlines": 1}, "lines"),
        ([1, 2], "a table of its fields"),
        (None, "a table of its fields"),
    ],
)
def test_bad_values(values, names):
    """Invalid values are refused with one line that names the source and the field."""
    with pytest.raises(InputError) as error:
        Outer.from_dict(values, "here")
    assert str(error.value).startswith("here: ") and names in str(error.value)
    assert len(str(error.value).splitlines()) == 1
    if isinstance(values, dict):
        with pytest.raises(InputError) as again:
            Outer(**values)
        assert f"here: {again.value}" == str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "name = ",
        "name = 'a'\nname = 'b'",
        "[inner",
        "[inner]\nrate = nan",
        "[inner]\nspeed = 1",
        "'two\\nlines' = 1",
        '"two\\nlines" = 1',
        "x = " + "1" * 5000,
        "x = " + "[" * 50_000,
    ],
)
def test_bad_toml(tmp_path, text):
    """An invalid file is refused with one line that begins with its path."""
    path = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        Outer.from_toml(path)
    assert str(error.value).startswith(f"{path}: ") and len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"events": {"time": 1.0}}, "events: must be a list, in TOML of tables that begin with [[events]]"),
        ({"initial_pose": 3.0}, "initial_pose: must be a list"),
    ],
)
def test_lists(values, said):
    """A table or a number in place of a list is called so in the words of the file."""
    with pytest.raises(InputError) as caught:
        Scenario.from_dict(values, "s.toml")
    assert str(caught.value) == f"s.toml: {said}"


def test_unreadable(tmp_path):
    """A missing file, a folder, an impossible path and bytes that are not UTF-8 are refused with one line."""
    (tmp_path / "bytes.toml").write_bytes(b"name = '\xff'")
    for path in (tmp_path / "none.toml", tmp_path, tmp_path / "bytes.toml", "a\0b"):
        with pytest.raises(InputError, match=r"^[^\n]+$"):
            Outer.from_toml(path)


def test_toml_matches_dict(tmp_path):
    """A TOML file makes the same record as its dictionary."""
    text = "name = 'a'\n[inner]\nrate = 2.5\n"
    assert Outer.from_toml(write(tmp_path, text)) == Outer.from_dict(tomllib.loads(text))
    assert Outer.from_toml(str(write(tmp_path, text))).inner.rate == 2.5


def test_file_of_another_version(tmp_path):
    """A file that mrctl wrote names its version, and so does the message where another version does not read it."""
    text = Outer().to_toml()
    assert text.startswith(f"# written by mrctl {mrctl.__version__}\n")
    for version, source in (("0.0.9", " (written by mrctl 0.0.9)"), (mrctl.__version__, "")):
        path = write(tmp_path, text.replace(mrctl.__version__, version))
        assert Outer.from_toml(path) == Outer()
        path.write_text(path.read_text() + "former = 1\n")
        with pytest.raises(InputError, match="former") as error:
            Outer.from_toml(path)
        assert str(error.value).startswith(f"{path}{source}: former")


def test_frozen():
    """The fields of a record cannot be changed."""
    with pytest.raises(ValueError, match="frozen"):
        Outer().name = "y"  # pyright: ignore[reportAttributeAccessIssue]


def test_copies():
    """`replace` validates everything; `model_copy` trusts values, but not names."""
    outer = Outer.from_dict({"inner": {"rate": 2.0}, "name": "a"})
    assert outer.replace(name="b") == outer.model_copy(update={"name": "b"}) == Outer(inner=Inner(rate=2.0), name="b")
    for copy in (outer.replace, lambda **fields: outer.model_copy(update=fields)):
        with pytest.raises(InputError, match="^nme: "):
            copy(nme="b")
    with pytest.raises(InputError, match="^name: "):
        outer.replace(name=3)


def test_field_docs():
    """The docstring under a field is its description, for help texts and sliders."""

    class Documented(Record):
        """A record."""

        rate: float = 1.0
        """Turns per second, of a wheel
        that rolls."""

    assert Documented.model_fields["rate"].description == "Turns per second, of a wheel that rolls."
    assert "rate: Turns per second, of a wheel that rolls." in Documented.__doc__


def public_records():
    """Returns the records among the public names, and those inside them."""
    found = [thing for name in mrctl.__all__ if isinstance(thing := getattr(mrctl, name), type)]
    found = [thing for thing in found if issubclass(thing, Record)]
    for record in found:  # which grows
        text = str([field.annotation for field in record.model_fields.values()])
        found += [r for r in Record.__subclasses__() if f"{r.__module__}.{r.__name__}" in text and r not in found]
    return found


@pytest.mark.parametrize("record", public_records(), ids=lambda record: record.__name__)
def test_help(record):
    """`help` says of every field what its source says under it, with the unit."""
    (tree,) = (
        node
        for node in ast.parse(Path(inspect.getfile(record)).read_text()).body
        if isinstance(node, ast.ClassDef) and node.name == record.__name__
    )
    words = " ".join(pydoc.plain(pydoc.render_doc(record)).replace("|", " ").split())
    fields = [n for n in tree.body if isinstance(n, ast.AnnAssign) and "ClassVar" not in ast.unparse(n.annotation)]
    assert {node.target.id for node in fields} == set(record.model_fields)
    for node in fields:
        below = tree.body[tree.body.index(node) + 1]
        assert isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant), node.target.id
        assert f" {node.target.id}: {' '.join(below.value.value.replace('|', ' ').split())}" in words
    assert " ".join(ast.get_docstring(tree).replace("|", " ").split()) in words


TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=30)
NUMBER = st.floats(-1, 1)


@given(name=TEXT, x=NUMBER, time=st.floats(0, 1e8), delay=st.integers(0, 50), points=st.booleans())
def test_toml(tmp_path_factory, name, x, time, delay, points):
    """A record written to TOML is read back to the bit, with quotes, control characters and small numbers."""
    event = Event(time=time, perturbation=Perturbation(payload=abs(x), payload_x=x, control_delay=delay / 100))
    reference = Waypoints() if points else Line(heading=x)
    scenario = Scenario(name=name, reference=reference, events=(event, Event(time=1, push=(x, 0, 1e-9))))
    path = tmp_path_factory.mktemp("toml") / "scenario.toml"
    path.write_bytes(scenario.to_toml().encode())
    assert Scenario.from_toml(path) == scenario


def test_names_in_the_place_of_records():
    """A robot, a tier and a perturbation may be given by name, in Python and in a file."""
    fields = {"robot": "turtlebot", "sensing": "field", "perturbation": "all"}
    named = Scenario(**fields)
    assert named == Scenario.from_dict(fields)
    assert (named.robot.path, named.sensing.tier) == ("turtlebot", "field")
    with pytest.raises(InputError, match=r"^sensing.tier: Input should be 'ideal'"):
        Scenario.from_dict({"sensing": "fild"})


@pytest.mark.parametrize(
    ("fields", "end"),
    [
        ({"perturbation": {"slope": 6.0}}, "perturbation.slope: Input should be less than or equal to 0.5 rad"),
        ({"perturbation": {"control_delay": 20}}, "less than or equal to 0.5 s"),
        ({"events": [{"time": 1, "reference": {"kind": "line", "speed": 900}}]}, "less than or equal to 20 m/s"),
        ({"laps": 0}, "greater than or equal to 1"),
        ({"mrac": {"noise": 0}}, "greater than or equal to 0.0001"),  # V √s
        ({"sensing": {"gyro_noise": -1}}, "greater than or equal to 0"),  # rad/s/√Hz
        ({"pid": {"steering_kp": -1}}, "greater than or equal to 0"),  # rad/s per rad/s
    ],
)
def test_unit_of_a_bound(fields, end):
    """A bound has the unit of the field's docstring, as who writes degrees or milliseconds must see."""
    with pytest.raises(InputError) as error:
        Scenario.from_dict(fields)
    assert str(error.value).endswith(end)


def test_part_of_a_pose():
    """A bad part of a pose has its name and unit, as 90° for a heading must be seen to be in rad."""
    with pytest.raises(InputError, match=r"^goal\.θ: Input should be a finite number"):
        Scenario(goal=(1.0, 0.0, math.inf))
    with pytest.raises(InputError, match=r"^start\.θ: Input should be less than or equal to 7 rad$"):
        Task.from_dict({"obstacles": {}, "start": (0, 0, 90), "goal": (1, 0, 0)})
    with pytest.raises(InputError, match=r"^reference\.waypoints\.points\.1\.1: "):  # which is no pose
        Scenario.from_dict({"reference": {"kind": "waypoints", "points": [(0, 0), (1, "y"), (2, 2)]}})


def test_paths():
    """A `pathlib.Path` is as good as its text where a field names a file, as it is for `load_robot` and `from_toml`."""
    fields = {"robot": "robot.xml", "world": "world.xml", "learned": "learned.safetensors", "fel": {"weights": "w.pt"}}
    paths = {name: Path(text) for name, text in fields.items() if isinstance(text, str)}
    assert Scenario(**paths, fel={"weights": Path("w.pt")}) == Scenario.from_dict(fields)
    with pytest.raises(InputError, match=r"^obstacles: no file none\.toml$"):
        Scenario(obstacles=Path("none.toml"))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"lap": 3}, "lap: there is no such field; did you mean laps?"),
        ({"events": [{"tim": 1}]}, "events.0.tim: there is no such field; did you mean time? (and 1 more)"),
        ({"colour": 1, "laps": 0}, "colour: there is no such field (and 1 more)"),
        ({"perturbation": {"mass": 2}}, "perturbation.mass: there is no such field; did you mean mass_factor?"),
        ({"perturbation": {"mas": 2}}, "perturbation.mas: there is no such field; did you mean mass_factor?"),
        (
            {"perturbation": {"frict": 2}},
            "perturbation.frict: there is no such field; did you mean tyre_friction_factor?",
        ),
        ({"sensing": {"teir": "lab"}}, "sensing.teir: there is no such field; did you mean tier?"),
        (
            {"reference": {"kind": "circle", "perod": 3}},
            "reference.circle.perod: there is no such field; did you mean period?",
        ),
        (
            {"reference": "circle"},
            'reference: must be a record, or a table of its fields, such as { kind = "circle" }',
        ),
        (
            {"obstacles": {"shapes": [3]}},
            'obstacles.shapes.0: must be a record, or a table of its fields, such as { kind = "disc" }',
        ),
        (
            {"runs": 3, "axes": []},
            "axes: is a field of a sweep, which `mrctl sweep FILE --out FOLDER` computes",
        ),
        (
            {"shapes": []},
            "shapes: is a field of obstacles; `mrctl navigate FILE --goal X,Y,θ` drives among them, and "
            'obstacles = "FILE" in a scenario names them',
        ),
        (
            {"controller": "a.py:A"},
            "controller: a scenario names no controller of your own; `mrctl run FILE --controller "
            "my_file.py:MyController` drives with one, and a sweep has a field controller",
        ),
        ({"robot": 3}, "robot: must be a record, or a table of its fields, or its path"),
        ({"events": Event(time=1, learning=False)}, "events: must be a list of records (and 7 more)"),
        ({"events": [{"time": 1.0, "push": [20.0, 0.0]}]}, "events.0.push: has 2 values, which are too few"),
        ({"goal": [1.0, 2.0]}, "goal: has 2 values, which are too few"),
        ({"goal": [1.0, 2.0, 3.0, 4.0]}, "goal: has 4 values, at most 3 are allowed"),
        (
            {"reference": Circle},
            "reference: must be a record, or a table of its fields, of which `kind` says what it is",
        ),
        (
            {"reference": {"radius": 1}},
            "reference: must be a record, or a table of its fields, of which `kind` says what it is",
        ),
        (
            {"reference": {"kind": "circel"}},
            "reference: 'kind' is 'circel', which is none of 'line', 'circle', 'lemniscate', 'lane_change', "
            "'rounded_square', 'stop_and_go', 'waypoints'",
        ),
    ],
)
def test_misspelt(values, says):
    """The message names the field that does not exist, even if another one is then missing, and the nearest one."""
    with pytest.raises(InputError) as refused:
        Scenario.from_dict(values)
    assert str(refused.value) == says


def test_assignment():
    """A record refuses a new value in one line that says what to do, and stays as it was."""
    scenario = Scenario()
    with pytest.raises(InputError, match=r"^laps: a record is frozen; replace\(laps=…\) returns one with .*$"):
        scenario.laps = 3
    assert scenario == Scenario()
