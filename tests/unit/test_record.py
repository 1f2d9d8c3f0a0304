"""What comes in from outside: either a valid record, or one line that names the field."""

import tomllib

import pytest

from mrctl.record import InputError, Record


class Inner(Record):
    """A part."""

    rate: float


class Outer(Record):
    """A whole."""

    name: str = "x"
    inner: Inner = Inner(rate=1.0)


def write(tmp_path, text):
    """A TOML file with the text."""
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"colour": 1}, "colour"),
        ({"inner": {"rate": "fast"}}, "inner.rate"),
        ({"inner": {"rate": float("nan")}}, "inner.rate"),
        ({"inner": {"rate": float("inf")}}, "inner.rate"),
        ({"inner": {"rate": 10**400}}, "inner.rate"),
        ({"inner": {}}, "inner.rate"),
        ({"inner": {"rate": 1, "x": 1}, "name": 3}, "name"),
        ({"two\nlines": 1}, "lines"),
        ([1, 2], "dictionary"),
        (None, "dictionary"),
    ],
)
def test_bad_values(values, names):
    """One line, with the place and the field."""
    with pytest.raises(InputError) as error:
        Outer.from_dict(values, "here")
    assert str(error.value).startswith("here: ") and names in str(error.value)
    assert len(str(error.value).splitlines()) == 1


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
    """One line that begins with the file."""
    path = write(tmp_path, text)
    with pytest.raises(InputError) as error:
        Outer.from_toml(path)
    assert str(error.value).startswith(f"{path}: ") and len(str(error.value).splitlines()) == 1


def test_unreadable(tmp_path):
    """No file, a folder, a path that cannot be one, and bytes that are not UTF-8."""
    (tmp_path / "bytes.toml").write_bytes(b"name = '\xff'")
    for path in (tmp_path / "none.toml", tmp_path, tmp_path / "bytes.toml", "a\0b"):
        with pytest.raises(InputError, match=r"^[^\n]+$"):
            Outer.from_toml(path)


def test_toml_matches_dict(tmp_path):
    """A file says what its dictionary says."""
    text = "name = 'a'\n[inner]\nrate = 2.5\n"
    assert Outer.from_toml(write(tmp_path, text)) == Outer.from_dict(tomllib.loads(text))
    assert Outer.from_toml(str(write(tmp_path, text))).inner.rate == 2.5


def test_frozen():
    """A record does not change."""
    with pytest.raises(ValueError, match="frozen"):
        Outer().name = "y"  # pyright: ignore[reportAttributeAccessIssue]


def test_field_docs():
    """The docstring under a field is its description, for help texts and sliders."""

    class Documented(Record):
        """A record."""

        rate: float = 1.0
        """Turns per second."""

    assert Documented.model_fields["rate"].description == "Turns per second."
