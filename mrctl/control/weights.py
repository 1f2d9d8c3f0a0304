"""Files of arrays that learners start from, such as the weights of `fel`."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mrctl import __version__
from mrctl.control.features import CHANNELS, FEATURES
from mrctl.kernel import Array
from mrctl.record import InputError, reading

MAX_BYTES = 64 * 2**20  # bytes of the arrays of a file


def shapes(hidden: int) -> dict[str, tuple[int, ...]]:
    """Returns names and shapes of the weights, in the order of the flat vector; `fel_torch.Network` has the same."""
    return {
        "hidden.weight": (hidden, FEATURES),
        "hidden.bias": (hidden,),
        "output.weight": (CHANNELS, hidden),
        "output.bias": (CHANNELS,),
        "direct.weight": (CHANNELS, FEATURES),
    }


def initial_weights(hidden: int, seed: int) -> Array:
    """Returns weights with a random hidden layer and zeros elsewhere, so that learning begins as pure PID.

    Returns:
        Flat weights, `(11 hidden + 18,)`.
    """
    rng = np.random.default_rng([seed, 1])
    layers = {name: np.zeros(shape) for name, shape in shapes(hidden).items()}
    for name in ("hidden.weight", "hidden.bias"):
        layers[name] = rng.normal(0.0, 0.5, layers[name].shape)
    return flatten(layers)


def flatten(layers: dict[str, Array]) -> Array:
    """Returns named weights as the flat vector of the compiled network."""
    hidden = len(layers["hidden.bias"])
    return np.concatenate([np.ravel(layers[name]) for name in shapes(hidden)])


def unflatten(weights: Array) -> dict[str, Array]:
    """Returns the flat vector as named weights."""
    return arrays_by_name(weights, shapes(hidden_units(len(weights))[0]))


def hidden_units(size: int) -> tuple[int, int]:
    """Returns the number of hidden units of a flat vector of this size, and how many numbers are left over."""
    return divmod(size - CHANNELS * (FEATURES + 1), FEATURES + 1 + CHANNELS)


def arrays_by_name(flat: Array, layout: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Returns views of a flat vector as arrays of these names and shapes, which follow each other in it."""
    found, start = {}, 0
    for name, shape in layout.items():
        stop = start + int(np.prod(shape))
        found[name], start = flat[start:stop].reshape(shape), stop
    return found


def save_weights(path: str | Path, weights: Array) -> None:
    """Writes flat weights of `fel`, `(n,)`, as a safetensors file, whose name must end in `.safetensors`.

    Raises:
        InputError: These are no weights of `fel`, or the file has another suffix or cannot be written.
    """
    flat = np.asarray(weights)
    units, left = hidden_units(flat.size)
    if flat.ndim != 1 or flat.dtype.kind not in "fiu" or units < 1 or left:
        kind = f"shape {flat.shape}" if flat.dtype.kind in "fiu" else f"type {type(weights).__name__}"
        raise InputError(
            f"weights: {kind} is not the flat weights of fel, (11 hidden + 18,), such as result.weights.values[0]; "
            "mrctl.save_learned saves what any learner has adapted"
        )
    write_arrays(path, unflatten(flat))


def load_weights(path: str | Path, hidden: int) -> Array:
    """Reads weights of `fel` from a safetensors file or a torch state dict.

    Args:
        path: A `.safetensors` file, or a file of `torch.save(module.state_dict())`, which is read with `weights_only`.
        hidden: Number of hidden units that the file must have.

    Returns:
        Flat weights, `(11 hidden + 18,)`.

    Raises:
        InputError: The file is missing, broken, of another shape, or holds non-finite numbers.
    """
    return flatten(read_arrays(path, "fel.weights", shapes(hidden)))


def write_arrays(path: str | Path, arrays: Mapping[str, Array], metadata: dict[str, str] | None = None) -> None:
    """Writes named arrays as a safetensors file, with the version of mrctl and `metadata`.

    Raises:
        InputError: The name does not end in `.safetensors`, by which `read_arrays` knows the format, or the file cannot
            be written.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(f"{path}: a file of weights must end in .safetensors, or no run could start from it")
    from safetensors.numpy import save

    contiguous = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    data = save(contiguous, metadata={"mrctl": __version__} | (metadata or {}))
    try:
        Path(path).write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot write weights: {error.strerror}") from None


def notes_on(path: str | Path) -> dict[str, str]:
    """Returns what `write_arrays` noted in a file beside its arrays; nothing where it notes nothing, or is broken."""
    if Path(path).suffix != ".safetensors" or not Path(path).is_file():
        return {}
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            return file.metadata() or {}
    except (SafetensorError, OSError):
        return {}


def read_arrays(path: str | Path, field: str, expected: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Reads arrays of these names and shapes, as float64.

    Args:
        path: A safetensors file, which ends in `.safetensors`, or one of `torch.save`.
        field: Field of the scenario that names the file, for messages.
        expected: Names and shapes.

    Raises:
        InputError: The file is missing, broken, of other shapes, or holds non-finite numbers.
    """
    if not Path(path).is_file():
        inside = Path(path) / "learned.safetensors"
        raise InputError(
            f"{field}: " + (f"{path} is a folder; give {inside}" if inside.is_file() else f"no file {path}")
        )
    size = Path(path).stat().st_size
    if zipfile.is_zipfile(path):  # as torch writes them
        with reading(path), zipfile.ZipFile(path) as archive:
            size = sum(part.file_size for part in archive.infolist())
    if size > MAX_BYTES:
        raise InputError(f"{field}: {path}: {size / 2**20:,.0f} MiB of weights, at most {MAX_BYTES / 2**20:g}")
    writer = ""
    try:
        if Path(path).suffix == ".safetensors":
            from safetensors import safe_open

            with safe_open(path, "numpy") as file:
                arrays = {name: file.get_tensor(name) for name in file.keys()}
                writer = (file.metadata() or {}).get("mrctl", "")
        else:
            import torch

            arrays = {k: v.double().numpy() for k, v in torch.load(path, map_location="cpu", weights_only=True).items()}
    except Exception as error:  # each format raises its own errors
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{field}: {path}: not a weights file: {reason}") from None
    for name, shape in expected.items():
        if name not in arrays or arrays[name].shape != shape:
            found = arrays[name].shape if name in arrays else "missing"
            by = f" (written by mrctl {writer})" if writer and writer != __version__ else ""
            raise InputError(f"{field}: {path}{by}: {name} is {found}, it must have shape {shape}")
    if unknown := set(arrays) - set(expected):
        raise InputError(f"{field}: {path}: unknown entry {min(unknown)!r}")
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise InputError(f"{field}: {path}: non-finite weights")
    return {name: arrays[name].astype(float) for name in expected}
