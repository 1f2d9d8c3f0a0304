"""Signals of a sweep as xarray reads them: only when they are used, and with the name of a file that is damaged."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from mrctl.kernel import Array
from mrctl.results.dataset import reading_chunks

DIMENSIONS = ("run", "time", "signal")


class _Signals(BackendArray):
    """An array in shards, each of which is read on its own."""

    def __init__(self, array: zarr.Array, shard: Callable[[int], Path]) -> None:
        self.shape, self.dtype = array.shape, array.dtype
        self._array, self._shard = array, shard

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Array:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> Array:
        """Returns the elements with these indices, one integer, slice or array for each dimension."""
        rows, *others = key
        runs = np.arange(self.shape[0])[rows]
        if not runs.size:
            return np.asarray(self._array.oindex[key])
        assert self._array.shards is not None
        owners, found = np.atleast_1d(runs) // self._array.shards[0], []
        for owner in np.unique(owners):
            with reading_chunks(self._shard(int(owner))):
                found.append(np.asarray(self._array.oindex[(np.atleast_1d(runs)[owners == owner], *others)]))
        whole = np.concatenate(found)[np.argsort(np.argsort(owners, kind="stable"))]
        return whole if np.ndim(runs) else whole[0]


class _Reader(BackendEntrypoint):
    """Opens a zarr array for xarray."""

    def open_dataset(  # type: ignore[override]
        self, filename_or_obj: Path, *, drop_variables: Iterable[str] | None = None, shard: Callable[[int], Path]
    ) -> xr.Dataset:
        array = zarr.open_array(filename_or_obj, mode="r", zarr_format=3)
        return xr.Dataset({"signals": (DIMENSIONS, indexing.LazilyIndexedArray(_Signals(array, shard)))})


def lazily(path: Path, shard: Callable[[int], Path]) -> xr.DataArray:
    """Opens the signals (run, time, signal) of a store; whoever uses those of a damaged shard gets an `InputError`.

    Args:
        path: The folder of the zarr array.
        shard: Returns the path of the shard with this number.
    """
    return xr.open_dataset(path, engine=_Reader, shard=shard)["signals"]
