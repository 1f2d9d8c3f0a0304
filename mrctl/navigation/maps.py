"""Maps of ROS: the yaml file of `map_server` with its image, and the obstacles that it shows.

The format is that of the package `map_server` (wiki.ros.org/map_server), which Nav2 kept.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import Field

from mrctl.kernel import Array
from mrctl.record import InputError, Record, read_file
from mrctl.theory.grid import check_size, rectangles
from mrctl.theory.obstacles import MAX_OBSTACLES, Box, Obstacles, Pose, turned

MAX_IMAGE_BYTES = 64 * 2**20  # bytes of an image
Share = Annotated[float, Field(ge=0, le=1)]


class MapFile(Record):
    """The yaml file of a map."""

    image: str
    """Path of the image, relative to the yaml file."""
    resolution: Annotated[float, Field(ge=1e-4, le=10)]
    """Side of a pixel in m."""
    origin: Pose
    """Pose of the lower left corner of the image: x and y in m, and its rotation in rad."""
    negate: bool = False
    """Whether white means occupied."""
    occupied_thresh: Share
    """Probability above which a pixel is occupied; that of a pixel is its share of black, or of white with `negate`."""
    free_thresh: Share
    """Probability below which a pixel is free."""
    mode: Literal["trinary", "scale"] = "trinary"
    """What is between the thresholds: unknown (`trinary`), or a probability (`scale`)."""


class Map(NamedTuple):
    """An occupancy grid."""

    occupancy: NDArray[np.int8]
    """Occupancy of each cell in per cent, −1 where unknown, `(rows, columns)`: rows go up, columns to the right."""
    resolution: float
    """Side of a cell in m."""
    origin: Array
    """Pose of the lower left corner in m, m, rad, `(3,)`."""

    def obstacles(self) -> Obstacles:
        """Merges the occupied cells into maximal rectangles, which may overlap.

        Raises:
            InputError: There are more than 20,000.
        """
        found = rectangles(self.occupancy == 100)
        if len(found) > MAX_OBSTACLES:
            raise InputError(
                f"map: {len(found):,} rectangles are more than {MAX_OBSTACLES:,}; take a coarser or a cleaner map"
            )
        size = (found[:, 2:] - found[:, :2]) * self.resolution
        middles = turned((found[:, 2:] + found[:, :2]) / 2 * self.resolution, self.origin)
        angle = float(self.origin[2])
        return Obstacles(
            shapes=tuple(
                Box(x=x, y=y, angle=angle, length=length, width=width)
                for (x, y), (length, width) in zip(middles.tolist(), size.tolist(), strict=True)
            )
        )


def read_map(path: str | Path) -> Map:
    """Reads a map of `map_server`.

    Args:
        path: The yaml file; its image is a png, a pgm, or whatever else Pillow reads.

    Raises:
        InputError: The file is no map, or its image is missing, no image, or larger than 20 million pixels.
    """
    content = read_file(path)
    try:
        values = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:  # as of a date that is none
        text = " ".join(str(error).replace('in "<byte string>", ', "").split())
        raise InputError(f"{path}: no yaml: {text}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: no map: not a yaml file of fields such as image and resolution")
    others = [str(name) for name in values if name not in MapFile.model_fields]  # which tools add
    try:
        file = MapFile.from_dict({k: v for k, v in values.items() if k in MapFile.model_fields}, str(path))
    except InputError as error:
        raise InputError(f"{error}; not known: {', '.join(others)}" if others else str(error)) from None
    if file.free_thresh >= file.occupied_thresh:
        raise InputError(f"{path}: free_thresh: must be below occupied_thresh")
    image = Path(path).parent / file.image
    if not image.is_file():
        raise InputError(f"{path}: image: no file {image}")
    pixels = _pixels(image)
    # As map_server: `trinary` averages transparency as one more channel, `scale` takes it for unknown.
    opaque = np.ones(pixels.shape[:2], bool)
    if file.mode == "scale" and pixels.shape[2] in (2, 4):
        opaque, pixels = pixels[..., -1] > 0, pixels[..., :-1]
    black = pixels.mean(axis=2) / 255
    black = black if file.negate else 1 - black
    between = 1 + 98 * (black - file.free_thresh) / (file.occupied_thresh - file.free_thresh)
    unknown = np.full(black.shape, -1) if file.mode == "trinary" else np.where(opaque, np.floor(between), -1)
    known = [black > file.occupied_thresh, black < file.free_thresh]
    occupancy = np.select(known, [100, 0], unknown).astype(np.int8)
    return Map(np.ascontiguousarray(occupancy[::-1]), file.resolution, np.array(file.origin))


def _pixels(path: Path) -> Array:
    """Reads an image as `(height, width, channels)` from 0 to 255, the upper row first.

    Raises:
        InputError: It is no image, or too large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(read_file(path, MAX_IMAGE_BYTES))) as image:
                check_size(image.height, image.width, f"{path}: image")
                if image.mode.startswith("I"):
                    return np.asarray(image, float)[..., None] / 257  # 16 bits
                if image.mode not in ("L", "RGB", "RGBA"):  # with transparency as a fourth channel, also beside grey
                    colours = "RGBA" if image.has_transparency_data else "RGB"
                    image = image.convert("L" if image.mode == "1" else colours)
                return np.asarray(image, float).reshape(image.height, image.width, -1)
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(f"{path}: no image that can be read") from None
    except (OSError, ValueError, SyntaxError, TypeError, NotImplementedError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: no image that can be read: {' '.join(str(error).split())}") from None
