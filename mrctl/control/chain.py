"""Chaining laws: one compiled loop over robots that runs several of them in turn.

A law is a NumPy ufunc, whose call costs a few microseconds. A control tick calls ten, for one robot as long as the
physics takes, so the loop compiles what it calls in turn into one function.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import float64, from_dtype, njit, types

GIVEN = types.Array(float64, 2, "A", readonly=True)  # an input that may be a view, `(B, n)`
ANY = types.Array(float64, 1, "A", readonly=True)  # the same, `(B,)`
OWN, EACH = float64[:, ::1], float64[::1]  # arrays of ours, `(B, n)` and `(B,)`


def rows(dtype: np.dtype) -> types.Array:
    """The type of an array with one record of `dtype` a robot, `(B,)`."""
    return types.Array(from_dtype(dtype), 1, "C")


def one(law: Callable[..., Any]) -> Callable[..., Any]:
    """The law for one robot, to be called in a compiled loop; the results have the same bits as the ufunc's."""
    return njit(law.__wrapped__)  # type: ignore[attr-defined]


def stamp(*laws: Callable[..., Any]) -> int:
    """A number that changes with the files that laws are written in.

    Numba's cache on disk keeps a function until its own file or what its closure holds changes. A loop over laws of
    other files therefore needs this number in its closure; otherwise it would go on with the laws of yesterday.
    """
    files = sorted({law.__wrapped__.__code__.co_filename for law in laws})  # type: ignore[attr-defined]
    digest = hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).digest()
    return int.from_bytes(digest[:7], "little")
