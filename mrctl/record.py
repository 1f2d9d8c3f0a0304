"""The base class of all settings: typed and frozen records that are read from TOML and validated."""

from __future__ import annotations

import contextlib
import difflib
import inspect
import json
import re
import stat
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic.fields import FieldInfo
from typing_extensions import override

from mrctl import __version__

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

MAX_TEXT_BYTES = 4 * 2**20  # bytes, largest text file of settings; one of this size takes some seconds to read
WRITTEN_BY = "# written by mrctl "  # how a TOML file begins that `to_toml` made
BOUNDS = "greater_than", "greater_than_equal", "less_than", "less_than_equal"  # errors of pydantic
_BASE = "(?:kg|rad|Hz|[msNVAΩH])²?"
UNIT = re.compile(rf" in ({_BASE}(?:[·/]{_BASE})*)(?=[.,;]| (?!per |√))")  # in the docstring of a field
POSE = re.compile("[Pp]ose.*: x and y in m, (?:θ|and its rotation) in rad")  # the docstring of a field that is a pose
FIELD_GONE = "this field of an earlier version is gone"


class InputError(ValueError):
    """Input from outside is invalid; the message is one line that names the field or the file."""


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turns any error that a library raises on a damaged file into one line that names the file.

    Raises:
        InputError: The file cannot be read.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 (readers raise errors of every kind on damaged files)
        text = printable(f"{type(error).__name__}: {error}")
        raise InputError(f"{path}: damaged or missing: {text[:300]}") from None


def read_file(path: str | Path, largest: int = MAX_TEXT_BYTES) -> bytes:
    """Reads a regular file of limited size, so that no pipe, device or huge file blocks the program.

    Args:
        path: The file.
        largest: Largest size in bytes.

    Raises:
        InputError: The file cannot be read, is a pipe or a device, or is too large.
    """
    try:
        found = Path(path).stat()
        if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode):
            raise InputError(f"{path}: a pipe or a device, not a file")
        if found.st_size > largest:
            raise InputError(f"{path}: larger than {largest / 2**20:g} MiB")
        return Path(path).read_bytes()
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{printable(str(path))}: {reason}") from None  # of a path that is the text of a file, too


def printable(text: str) -> str:
    """Returns a text from outside as one line of at most 2,000 characters without control characters."""
    words = " ".join(
        "".join(c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text).split()
    )
    return words if len(words) <= 2000 else f"{words[:1000]} … {words[-900:]}"


def bounds(field: FieldInfo) -> dict[type, float]:
    """Returns the limits of a number by the kind of comparison, `Ge`, `Gt`, `Le` or `Lt`."""
    return {type(m): getattr(m, type(m).__name__.lower()) for m in field.metadata if isinstance(m, Ge | Gt | Le | Lt)}


def with_limits(description: str, field: FieldInfo) -> str:
    """Returns the description of a field with its limits, if it is a number that has both and does not say them yet."""
    limits, words = bounds(field), {Ge: "at least", Gt: "above", Le: "at most", Lt: "below"}
    if len(limits) < 2:
        return description
    numbers = {kind: str(n) if isinstance(n, int) else f"{n:.12g}" for kind, n in limits.items()}
    said = ", ".join(f"{words[kind]} {numbers[kind]}" for kind in words if kind in limits)
    added = f"{said.capitalize()}."
    return description if description.endswith(added) else f"{description} {added}".lstrip()


class _Constructors(ModelMetaclass):
    """Lets the constructors of records refuse bad fields as `Record.from_dict` does.

    The error of pydantic has four lines and an address. Records that are parts of others are not made by constructors.
    """

    if not TYPE_CHECKING:  # which would take it for the signature of every constructor

        def __call__(cls, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            """Makes a record.

            Raises:
                InputError: A field is unknown, missing or out of range; the message names the first one.
            """
            try:
                return super().__call__(*args, **kwargs)
            except ValidationError as error:
                raise InputError(describe(error, record=cls)) from None


class Record(BaseModel, metaclass=_Constructors):
    """A frozen record of settings, which refuses unknown keys and numbers that are not finite.

    The docstring under a field is its description in help texts, in the viewer and in the docstring of the class.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
    moved: ClassVar[dict[str, str]] = {}
    """Fields of earlier versions, each with the advice what to set in its place."""
    foreign: ClassVar[dict[str, str]] = {}
    """Fields of other records whose files may be taken for those of this one, each with what its record is for."""
    named_by: ClassVar[str] = ""
    """Field that a string sets which stands in the place of a record; by default none does."""

    if TYPE_CHECKING:

        def __hash__(self) -> int:
            """Pydantic gives frozen records a hash."""
            ...

    @classmethod
    @override
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Makes each field's docstring one line with its limits, and adds it to that of the class, for `help`."""
        super().__pydantic_init_subclass__(**kwargs)
        lines = []
        for name, field in cls.model_fields.items():
            if field.description:
                field.description = with_limits(" ".join(field.description.split()), field)
                text = f"{name}: {field.description}"
                lines.append(textwrap.fill(text, 112, initial_indent=4 * " ", subsequent_indent=8 * " "))
        if lines and cls.__doc__:
            cls.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__), "", "Attributes:", *lines])

    @model_validator(mode="before")
    @classmethod
    def _from_a_name(cls, values: Any) -> Any:  # noqa: ANN401
        return {cls.named_by: values} if cls.named_by and isinstance(values, str) else values

    @model_validator(mode="before")
    @classmethod
    def _has_paths_as_text(cls, values: Any) -> Any:  # noqa: ANN401
        if not isinstance(values, dict):
            return values
        return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}

    @model_validator(mode="before")
    @classmethod
    def _knows_moved_fields(cls, values: Any) -> Any:  # noqa: ANN401
        for name in cls.moved.keys() & values.keys() if isinstance(values, dict) else ():
            raise ValueError(f"{name}: {FIELD_GONE}; {cls.moved[name]}")
        for name in cls.foreign if isinstance(values, dict) else ():
            if name in values:
                raise ValueError(f"{name}: {cls.foreign[name]}")
        return values

    @classmethod
    def refuse_moved(cls, path: str) -> None:
        """Refuses the dotted path of a field if that is one of an earlier version.

        Raises:
            InputError: It is; the message says what to set in its place.
        """
        values: object = None
        for part in reversed(path.split(".")):
            values = {part: values}
        try:
            cls.from_dict(values)
        except InputError as error:
            if FIELD_GONE in str(error):
                raise

    def replace(self, **changes: Any) -> Self:  # noqa: ANN401
        """Returns the record with other values in these fields, validated as a whole.

        Raises:
            InputError: A field is unknown or a value is invalid; the message names the field.
        """
        return self.from_dict({name: getattr(self, name) for name in type(self).model_fields} | changes)

    @override
    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copies as pydantic does, without validating values, but refuses unknown fields as `replace` does.

        Raises:
            InputError: A field is unknown.
        """
        for name in (update or {}).keys() - type(self).model_fields.keys():
            self.replace(**{name: (update or {})[name]})
        return super().model_copy(update=update, deep=deep)

    if not TYPE_CHECKING:  # which knows that a record is frozen

        def __setattr__(self, name: str, value: object) -> None:
            """Refuses to change a field, in one line in place of the four of pydantic.

            Raises:
                InputError: The name is that of a field, or of none.
            """
            try:
                super().__setattr__(name, value)
            except ValidationError:
                how = f"replace({name}=…) returns one with another value"
                raise InputError(f"{name}: a record is frozen; {how}") from None

    @classmethod
    def from_dict(cls, values: object, source: str = "") -> Self:
        """Validates plain data.

        Args:
            values: A dictionary of the fields, as read from a TOML or JSON file.
            source: Name of the file or of the record, which begins the error message.

        Raises:
            InputError: A field is unknown, missing or out of range; the message names the first one.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise InputError(describe(error, source, cls)) from None
        except OSError as error:  # raised by a field that names a file
            raise InputError(printable(f"{source}: {error.filename}: {error.strerror}".removeprefix(": "))) from None

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Reads and validates a TOML file.

        Raises:
            InputError: The file cannot be read, is not TOML, or names a bad field; the message names the version of
                mrctl that wrote the file, if another one did.
        """
        try:
            text = read_file(path).decode()
        except UnicodeDecodeError:
            raise InputError(f"{path}: not TOML: no text in UTF-8") from None
        try:
            values = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not TOML: {error}") from None
        first = text.partition("\n")[0]
        another = first.startswith(WRITTEN_BY) and first != WRITTEN_BY + __version__
        return cls.from_dict(values, f"{path} ({first.removeprefix('# ')})" if another else str(path))

    def to_toml(self) -> str:
        """Returns the fields as TOML that `from_toml` reads back, with one line for each that is not None.

        The first line is a comment with the version of mrctl. A list of records has one line for each of its elements.

        Raises:
            InputError: A value within a list or a table is None, which TOML cannot say.
        """
        return f"{WRITTEN_BY}{__version__}\n" + "".join(
            f"{name} = {_toml(value, nested=False)}\n"
            for name, value in self.model_dump(mode="json", exclude_none=True).items()
        )


def _toml(value: Any, nested: bool = True) -> str:  # noqa: ANN401
    """Returns a value as TOML; numbers, booleans and strings are written as in JSON, and DEL is escaped."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if value is None:
        raise InputError("TOML cannot say None, which a value within a list or a table is")
    if isinstance(value, list) and not nested and any(isinstance(item, dict) for item in value):
        return "[\n" + "".join(f"    {_toml(item)},\n" for item in value) + "]"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def describe(error: ValidationError, source: str = "", record: type[Record] | None = None) -> str:
    """Returns a pydantic error as one line: `source: field.subfield: reason`.

    A field that does not exist comes first: it may be why another one is missing.

    Args:
        error: The error.
        source: Name of the file or of the record.
        record: The record that is refused, among whose fields is the one for which a misspelt one may stand.
    """
    first, *rest = sorted(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    *parents, last = first["loc"] or [""]
    if last in (0, 1, 2) and POSE.match(_description(record, parents)):
        last = "xyθ"[last]
    field = ".".join(map(str, [*parents, last]))
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        *parents, name = first["loc"]
        known = [field for one in _records_at(record, parents) for field in one.model_fields]
        message = "there is no such field" + instead(str(name), known)
    if first["type"] in ("model_type", "model_attributes_type"):
        names = {one.named_by for one in _records_at(record, first["loc"])} - {""}
        message = ", or its ".join(["must be a record, or a table of its fields", *sorted(names)])
        if isinstance(first["input"], tuple) and isinstance(first["loc"][-1], int):  # one record, field by field
            field, message = field.rpartition(".")[0], "must be a list of records"
    if first["type"] == "union_tag_not_found":
        message = "must be a record, or a table of its fields, of which `kind` says what it is"
    if first["type"] == "union_tag_invalid":
        context = first.get("ctx", {})
        message = f"'kind' is {context.get('tag')!r}, which is none of {context.get('expected_tags')}"
    kinds = [
        one.model_fields["kind"].default for one in _records_at(record, first["loc"]) if "kind" in one.model_fields
    ]
    if len(kinds) > 1 and first["type"] in ("model_type", "model_attributes_type"):
        kind = first["input"] if first["input"] in kinds else kinds[0]
        message += f', such as {{ kind = "{kind}" }}'
    if first["type"] == "missing" and isinstance(first["loc"][-1], int):
        field, message = field.rpartition(".")[0], f"has {len(first['input'])} values, which are too few"
    if first["type"] == "too_long":
        context = first.get("ctx", {})
        message = f"has {context.get('actual_length')} values, at most {context.get('max_length')} are allowed"
    if first["type"] == "tuple_type":  # a file has no tuples
        tables = (
            f", in TOML of tables that begin with [[{first['loc'][-1]}]]" if isinstance(first["input"], dict) else ""
        )
        message = f"must be a list{tables}"
    if first["type"] in BOUNDS:
        message += _unit(record, first["loc"])
    more = f" (and {len(rest)} more)" if rest else ""
    return printable(": ".join(part for part in (source, field, message) if part) + more)


def _unit(record: type[Record] | None, path: Sequence[int | str]) -> str:
    """Returns the unit that a field's docstring gives, with a space before it; "" where it gives none."""
    about = _description(record, path)
    if not about and POSE.match(_description(record, path[:-1])):
        return " rad" if path[-1] == 2 else " m"
    found = UNIT.search(about)
    return f" {found[1]}" if found else ""


def _description(record: type[Record] | None, path: Sequence[int | str]) -> str:
    """Returns the docstring of the field at a path within a record; "" where that is none."""
    *parents, name = path or [""]
    fields = [one.model_fields[str(name)] for one in _records_at(record, parents) if str(name) in one.model_fields]
    return (fields[0].description or "") if fields else ""


def is_whole(count: float) -> bool:
    """Tells whether a number of periods is whole, to a millionth of a period."""
    return abs(count - round(count)) <= 1e-6


def nearest(name: str, known: Sequence[str]) -> str | None:
    """Returns the known field or flag for which a name that nobody knows probably stands; None if it is like no other.

    Those that begin with the name come first, then those of the same record with a word that does, as `friction` of
    `drive_friction_factor`, and then those of similar letters.
    """
    record, dot, last = name.rpartition(".")
    begun = [one for one in known if one.startswith(name)]
    inside = [
        one for one in known
        if one.startswith(record + dot) and any(w.startswith(last) for w in re.split("[._-]", one.removeprefix(record)))
    ]  # fmt: skip
    found = difflib.get_close_matches(name, begun or inside or known, 1, cutoff=0.0 if begun or inside else 0.6)
    return found[0] if found else None


def instead(name: str, known: Sequence[str]) -> str:
    """Returns the end of a message about an unknown name: the one that is probably meant, or all if they are few."""
    if meant := nearest(name, known):
        return f"; did you mean {meant}?"
    return f"; there are {', '.join(known)}" if 0 < len(known) <= 12 else ""


def _records_at(record: type[Record] | None, path: Sequence[int | str]) -> list[type[Record]]:
    """Returns the records that may stand at a path of fields, indices and kinds within one; none if that is unknown."""
    found = [record] if record else []
    for part in path:
        fields = [one.model_fields[str(part)].annotation for one in found if part in one.model_fields]
        kinds = [one for one in found if "kind" in one.model_fields and one.model_fields["kind"].default == part]
        found = kinds or [one for annotation in fields for one in _records_in(annotation)] or found
    return found


def _records_in(annotation: object) -> list[type[Record]]:
    """Returns the records in an annotation, such as those of a union or of a tuple."""
    if isinstance(annotation, type) and issubclass(annotation, Record):
        return [annotation]
    return [one for part in get_args(annotation) for one in _records_in(part)]
