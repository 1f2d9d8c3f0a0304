"""Refuses an MJCF file that would take MuJoCo minutes or gigabytes, before MuJoCo reads it.

MuJoCo expands a `<replicate>` of any count, attaches bodies to each other again and again, makes height fields,
textures and meshes of any size, and waits for ever on a pipe. A few lines of XML are enough for each of these.
"""

from __future__ import annotations

import contextlib
import math
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from typing_extensions import override

from mrctl.record import InputError, read_file
from mrctl.theory.grid import MAX_CELLS, check_size

MAX_ASSET_BYTES = 64 * 2**20  # bytes of a mesh or an image
MAX_MJCF_BYTES = 16 * 2**20  # bytes of an MJCF file, which may contain the vertices of meshes
MAX_WRITTEN_ELEMENTS = 20_000  # elements of a file; MuJoCo compiles so many geoms in 2 s, and 50,000 in more than 15 s
MAX_GENERATED_ELEMENTS = 10_000  # elements that are made beside those written, by a count or by <attach>; 7 s
MAX_DEPTH = 400  # elements within each other; MuJoCo stops at 500, and Python's stack at some more
MAX_ATTACH_CHAIN = 10  # files of which each attaches the next
MAX_RAYS = 1e6  # of all rangefinders that look through cameras

MAX_PRODUCTS: dict[str, list[tuple[tuple[str, ...], str, float]]] = {
    "camera": [(("resolution",), "pixels", MAX_CELLS)],
    "composite": [(("count",), "bodies", 250)],  # nested ones; 1,000 take more than 12 s
    "flex": [(("cellcount",), "cells", 1e3)],
    "flexcomp": [(("count",), "nodes", 3e3), (("cellcount",), "cells", 1e3)],  # 2 s
    "global": [(("offwidth", "offheight"), "pixels", MAX_CELLS)],
    "hfield": [(("nrow", "ncol"), "cells", MAX_CELLS)],
    "numeric": [(("size",), "values", 500)],  # MuJoCo writes further ones beyond the end of its stack
    "texture": [(("width", "height"), "pixels", MAX_CELLS)],
}
"""Attributes of an element whose product is the number of something, and the most of it."""

MAX_ATTRIBUTES: dict[str, float] = {
    "memory": 2**30, "nstack": 1e8, "njmax": 1e5, "nconmax": 1e5, "nuserdata": 1e6, "nkey": 1e3,
    **{f"nuser_{kind}": 1e3 for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
    "num": 1e4, "dim": 1e4, "nsample": 1e5, "subgrid": 20,
    "numslices": 1e3, "numstacks": 1e3, "numquads": 1e3, "shadowsize": 2**14, "offsamples": 64,
}  # fmt: skip
"""Largest values of the attributes that alone, in any element, determine what MuJoCo allocates."""

NAMES = "name", "class", "childclass", "model", "prefix"
"""Attributes that may have any word as their value."""

MAX_VERTICES = 22_500  # of a built-in mesh, such as a supersphere of 150 by 150; 1 s
MAX_EDGES = 1_000  # of a built-in cone, for whose hull the time grows with their square
MAX_LENGTHRANGE_STEPS = 1e4  # of the simulation that finds the length range of an actuator; by default 1,000
LENGTHRANGE = {"inttotal": 10.0, "timestep": 0.01}  # what these attributes are by default, in s
SUFFIXES = {suffix: 1024.0**power for power, suffix in enumerate("KMGTPE", start=1)}  # of the attribute `memory`


@contextlib.contextmanager
def compiling(path: str | Path, *others: str | Path) -> Iterator[None]:
    """Turns what MuJoCo raises on a model that it cannot compile into one line that names the file.

    A line that names one of the other files stays as it is. Besides `ValueError` these are `MemoryError`, and
    `RuntimeError` or MuJoCo's `FatalError` where a library under it fails. Errors of Python, which are others, pass.

    Raises:
        InputError: MuJoCo cannot compile the model.
    """
    try:
        yield
    except Exception as error:
        if not isinstance(error, (ValueError, MemoryError, RuntimeError)) and type(error).__name__ != "FatalError":
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        named = text.startswith(tuple(f"{file}: " for file in (path, *others)))
        raise InputError(text if named else f"{path}: {text}") from None


def check_bounds(path: Path) -> None:
    """Refuses an MJCF file that asks for more than a robot needs.

    The files that it includes or attaches, and the meshes and images that it names, are checked as well.

    Raises:
        InputError: A count, a size or a file is too large, or a file is no XML; the message names file and element.
    """
    _File(path, (), {})


class _Tree(ElementTree.TreeBuilder):
    """Builds the tree of a file, and stops at what makes trees grow or hides what they contain."""

    def __init__(self, path: Path, written: int) -> None:
        """Takes the path of the file, and the number of elements in the files that were read before it."""
        super().__init__()
        self.path, self.written = path, written

    def doctype(self, *_: object) -> NoReturn:
        """Refuses a document type, which MuJoCo ignores, and with which entities can stand for gigabytes."""
        raise InputError(f"{self.path}: <!DOCTYPE> has no place in MJCF")

    @override
    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        """Opens an element; a namespace is left out of its name, since MuJoCo knows none."""
        self.written += 1
        if self.written > MAX_WRITTEN_ELEMENTS:
            raise InputError(f"{self.path}: more than {MAX_WRITTEN_ELEMENTS:,} elements")
        return super().start(tag.rpartition("}")[2], attrs)


class _File:
    """A file with what it includes, as MuJoCo reads it: the elements that it makes are counted, not made.

    Attributes:
        total: Number of elements, of those within `<replicate>` and of attached ones each copy.
    """

    def __init__(self, path: Path, within: tuple[Path, ...], known: dict[Path, float]) -> None:
        """Counts the elements.

        Args:
            path: The file.
            within: The files that attach this one, from the outermost to the innermost.
            known: The totals of the files that have been counted.
        """
        if path.resolve() in within or len(within) > MAX_ATTACH_CHAIN:
            raise InputError(f"{path}: attaches itself, or <model> is nested more than {MAX_ATTACH_CHAIN} deep")
        self.path, self.total, self.written = path, 0.0, 0
        self.folders = {path.parent}
        self.included: dict[ElementTree.Element, Path] = {}
        self.named: dict[str, float] = {}  # number of elements of each body or frame that is complete
        root = self._parsed(path)
        self._include(root)
        self.settings = {
            one.get(kind, "") for one in root.iter("compiler") for kind in ("meshdir", "texturedir", "assetdir")
        }
        self.models: dict[str, float] = {}  # totals of the files that can be attached
        for element in root.iter():
            names = [value for name, value in element.items() if name.startswith("file")]
            for file in (file for name in names for file in self._at(name)):
                if element.tag == "model":
                    if file.resolve() not in known:
                        known[file.resolve()] = _File(file, (*within, path.resolve()), known).total
                    name = element.get("name", "")
                    self.models[name] = max(self.models.get(name, 0.0), known[file.resolve()])
                elif element.tag.lower() != "include":
                    _check_asset(file)
        self._count(root, path, 1)
        looks = sum("camera" in element.attrib for element in root.iter("rangefinder"))
        rays = max((_amount(element, path, "resolution") for element in root.iter("camera")), default=0.0) * looks
        if rays > MAX_RAYS:
            raise InputError(f"{path}: <rangefinder> asks for {rays:,.0f} rays; at most {MAX_RAYS:,.0f}")

    def _parsed(self, path: Path) -> ElementTree.Element:
        """Returns the root of a file; like MuJoCo it takes all text as UTF-8 and passes over bytes that are not."""
        text = read_file(path, MAX_MJCF_BYTES).decode("utf-8-sig", errors="replace")
        tree = _Tree(path, self.written)
        parser = ElementTree.XMLParser(target=tree)
        try:
            parser.feed(text)
            root = parser.close()
        except ElementTree.ParseError as error:
            hint = "; a comment must not contain '--'" if "invalid token" in str(error) else ""
            raise InputError(f"{path}: not XML: {error}{hint}") from None
        self.written = tree.written
        return root

    def _include(self, root: ElementTree.Element) -> None:
        """Puts the contents of included files into the elements that include them, as MuJoCo does."""
        left, seen = [(root, self.path.parent)], {self.path.resolve()}
        while left:
            element, folder = left.pop()
            name = element.get("file", "")
            if element.tag.lower() == "include" and name and not len(element):
                file = next((file for file in (self.path.parent / name, folder / name) if _exists(file)), None)
                if file is not None:
                    if file.resolve() in seen:
                        raise InputError(f"{file}: is included twice")
                    seen.add(file.resolve())
                    self.included[element] = file
                    self.folders.add(file.parent)
                    element.extend(self._parsed(file))
                    folder = file.parent
            left += [(child, folder) for child in element]

    def _at(self, name: str) -> list[Path]:
        """Returns the files that a name may stand for; MuJoCo takes one of them, with or without the name's folder."""
        folders = {folder / setting for folder in self.folders for setting in ("", *self.settings)}
        found = {folder / one for folder in folders for one in (name, Path(name).name) if one}
        return sorted(file for file in found if _exists(file))

    def _count(self, element: ElementTree.Element, file: Path, depth: int) -> tuple[float, float]:
        """Returns how many elements an element and its contents are as written, and how many are made beside these.

        Raises:
            InputError: There are too many, or an attribute asks for too much.
        """
        file, tag = self.included.get(element, file), element.tag
        if depth > MAX_DEPTH:
            raise InputError(f"{file}: <{tag}> is nested more than {MAX_DEPTH} deep")
        for what, asked, most in _requests(element, file):
            if asked > most:
                raise InputError(f"{file}: <{tag}> asks for {asked:,.0f} {what}; at most {most:,.0f}")
        written, made = 1.0, self._made_by(element, file)
        self.total += 1 + made
        for child in element:
            more = self._count(child, file, depth + 1)
            written, made = written + more[0], made + more[1]
        if tag == "replicate":
            copies = max(0.0, _amount(element, file, "count") - 1) * (written - 1 + made)
            made, self.total = made + copies, self.total + copies
        if made > MAX_GENERATED_ELEMENTS:
            raise InputError(
                f"{file}: <{tag}> makes {written + made:,.0f} elements; at most {MAX_GENERATED_ELEMENTS:,}"
            )
        _check_finite(element, file)
        if tag in ("body", "frame") and "name" in element.attrib:
            self.named[element.attrib["name"]] = written + made
        return written, made

    def _made_by(self, element: ElementTree.Element, file: Path) -> float:
        """Returns how many elements an element makes itself.

        What an `<attach>` names may not be complete yet, or have got its name by another `<attach>`; it then has at
        most the elements so far.
        """
        if element.tag in ("composite", "flexcomp"):
            return _amount(element, file, "count")
        if element.tag == "model" or (element.tag == "attach" and "model" in element.attrib):
            name = element.get("name" if element.tag == "model" else "model", "")
            return self.models.get(name, max(self.models.values(), default=0.0))
        if element.tag == "attach":
            return self.named.get(element.get("body", element.get("frame", "")), self.total)
        return 0.0


def _check_finite(element: ElementTree.Element, file: Path) -> None:
    """Refuses NaN, in whose place MuJoCo takes its default, and infinity, which only a range may have."""
    for name, value in element.items():
        words = {word.lower().lstrip("+-").partition("(")[0] for word in value.split()} & {"nan", "inf", "infinity"}
        if name not in NAMES and element.tag != "text" and (words if not name.endswith("range") else words & {"nan"}):
            whose = f"{element.tag} {element.get('name', '')}".strip()
            raise InputError(f"{file}: <{whose}> {name}: {value!r} is not finite")


def _requests(element: ElementTree.Element, file: Path) -> Iterator[tuple[str, float, float]]:
    """Yields what the attributes of an element ask for: what it is, how many, and the most."""
    tag, given = element.tag, element.attrib
    for attributes, what, most in MAX_PRODUCTS.get(tag, ()):
        yield what, math.prod(_amount(element, file, name) for name in attributes), most
    for name in sorted(given.keys() & MAX_ATTRIBUTES.keys()):
        yield f"as {name}", _amount(element, file, name), MAX_ATTRIBUTES[name]
    if tag == "texture" and given.get("type") != "2d" and "builtin" in given:  # six of them; the height is ignored
        yield "pixels of a face", _amount(element, file, "width") ** 2, MAX_CELLS / 4
    elif tag == "numeric":
        yield "values", len(given.get("data", "").split()), 500
    elif tag == "lengthrange":
        duration, step = (_amount(element, file, name, default) for name, default in LENGTHRANGE.items())
        yield "steps", duration / step if step else math.inf, MAX_LENGTHRANGE_STEPS
    elif tag == "mesh" and "params" in given:
        kind, first = given.get("builtin"), _number(given["params"].split()[:1], file, "mesh> params")
        if kind == "cone":
            yield "edges", first, MAX_EDGES
        elif kind in ("wedge", "plate"):
            yield "vertices", _number(given["params"].split()[:2], file, "mesh> params"), MAX_VERTICES
        elif kind in ("supersphere", "supertorus"):
            yield "vertices", first**2, MAX_VERTICES
    elif tag == "config" and given.get("key") in ("size", "nchannel"):  # of the plugin `touch_grid`
        yield str(given["key"]), _amount(element, file, "value"), 1e5


def _amount(element: ElementTree.Element, file: Path, name: str, default: float = 1.0) -> float:
    """Returns the product of the magnitudes of the numbers in an attribute, or `default` if it is absent."""
    return _number(element.attrib[name].split(), file, f"{element.tag}> {name}") if name in element.attrib else default


def _number(texts: list[str], file: Path, where: str) -> float:
    """Returns the product of the magnitudes of some numbers.

    Raises:
        InputError: One of them is not a number.
    """
    found = 1.0
    for text in texts:
        factor = SUFFIXES.get(text[-1:].upper(), 1.0)
        try:
            number = abs(float(text[:-1] if factor > 1 else text)) * factor
        except ValueError:
            raise InputError(f"{file}: <{where}: {text!r} is not a number") from None
        found *= math.inf if math.isnan(number) else number
    return math.inf if math.isnan(found) else found


def _exists(file: Path) -> bool:
    """Tells whether there is a file of this name, which may be too long for one."""
    try:
        return file.exists() and not file.is_dir()
    except (OSError, ValueError):
        return False


def _check_asset(file: Path) -> None:
    """Refuses a mesh or image that is not a regular file, is too large, or is a PNG of too many pixels."""
    head = read_file(file, MAX_ASSET_BYTES)[:24]
    if head.startswith(b"\x89PNG") and len(head) == 24:
        width, height = struct.unpack(">II", head[16:])
        check_size(height, width, str(file))
