"""Laws as compiled functions: `@kernel` turns a function for one robot, on named records, into machine code.

A kernel is written as in a textbook, with arrays for vectors and a NumPy record for what is kept of a robot
(`s.integral[k]`), and it may call other kernels. Numba compiles it when it is first called, not at import, for the
types that it is called with; it releases Python's global lock, and the machine code is kept on disk. Kernels copy
arrays element by element: with `a[:] = b` Numba also compiles its message about unequal shapes, which takes 3 s. In a
kernel a division by zero gives ±∞ or NaN, as in NumPy.

The code on disk is valid for one state of all files that hold kernels: whoever edits a law gets the new law in every
kernel that calls it, wherever that is written. Constants that a kernel uses must therefore stand in such a file.
"""

from __future__ import annotations

import gc
import hashlib
import os
import sys
import warnings
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from types import CellType, FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Row = Any
"""One record of a structured array; type checkers cannot know its fields, which its dtype names."""
Rows = Any
"""A structured array, one record a robot, `(B,)`."""

COMPILING = "mrctl: compiling the laws that this needs for the first time, up to half a minute"

P = ParamSpec("P")
T = TypeVar("T")


class Kernel(Generic[P, T]):
    """A function that is compiled when it is first called.

    Attributes:
        law: The function as it is written.
    """

    def __init__(self, law: Callable[P, T], laws: dict[str, Any] | None = None) -> None:
        """Takes the function, and kernels or readers of `Held` by the global names in it that they replace."""
        self.law, self._laws = law, laws or {}
        update_wrapper(self, law)

    @cached_property
    def compiled(self) -> Callable[P, T]:
        """The compiled function; a call of it is 0.2 µs faster than a call of the kernel."""
        return self._compiled(pipeline_class=_compilers()[0])

    @cached_property
    def inlined(self) -> Callable[P, T]:
        """The compiled function for calls from other kernels; Python cannot call it."""
        # Between kernels a call of a small one takes longer than its law, because each array is handed over in parts.
        return self._compiled(pipeline_class=_compilers()[1], forceinline=True, no_cpython_wrapper=True)

    def _compiled(self, **options: Any) -> Callable[P, T]:  # noqa: ANN401
        """Returns the function as Numba compiles it with further options."""
        from numba import njit

        _known_to_numba()
        law: Any = self.law
        # Numba looks a function up on disk by its code and by what its closure holds.
        version = repr((kernel_files_digest(), self._names(), sorted(options)))
        code = law.__code__.replace(co_freevars=("version",))
        versioned = FunctionType(
            code, law.__globals__ | self._laws, law.__name__, law.__defaults__, (CellType(version),)
        )
        update_wrapper(versioned, law)
        # A check of each division for zero would keep loops with a division from vector instructions.
        options |= {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        made: Any = njit(**options)(versioned)
        made._cache.save_overload = _where_possible(made._cache.save_overload)
        return made

    def repeated(self) -> Callable[..., T]:
        """Returns the compiled function for one caller, who promises that the types of its arguments never change.

        In each call of `compiled` Numba looks up the types of all arguments, which takes 0.3 to 1 µs; here it does so
        in the first call alone. Later arguments are taken to have the dtype, the number of dimensions and the memory
        layout of the first ones; where they have not, memory is misread or overwritten.
        """
        entry: Callable[..., T] | None = None

        def call(*arguments: Any) -> T:  # noqa: ANN401
            nonlocal entry
            if entry is None:
                compiled: Any = self.compiled
                answer = compiled(*arguments)
                overloads = compiled.overloads
                if len(overloads) > 1:  # else it is not looked up which of them was called, which takes 2 ms
                    types = tuple(compiled.typeof_pyval(argument) for argument in arguments)
                    entry = overloads[types].entry_point
                else:
                    entry = next(iter(overloads.values())).entry_point
                return answer
            return entry(*arguments)

        return call

    def _names(self) -> tuple[Any, ...]:
        """Names of the function and, recursively, of the kernels that replace its global names."""
        called = sorted(
            (name, law._names() if isinstance(law, Kernel) else law.kinds) for name, law in self._laws.items()
        )
        return self.law.__module__, self.law.__qualname__, called

    def __call__(self, *arguments: P.args, **options: P.kwargs) -> T:
        """Calls the compiled function."""
        return self.compiled(*arguments, **options)

    def calling(self, **laws: Any) -> Kernel[P, T]:  # noqa: ANN401
        """Returns the kernel with some of the functions that it calls replaced.

        `update.calling(respond=law)` compiles `update` with `law` wherever its source says `respond`. For the same
        functions it is the same kernel, because compiled code is never freed.
        """
        return _calling(self.law, *laws.items())


class Held:
    """Arrays that a kernel finds by an address, for one caller who calls it in every tick.

    Numba unpacks each array among the arguments in each call, which takes 0.07 µs; these it unpacks never. They stay
    where they are as long as this object lives, and the kernel must not be called after that.

    Attributes:
        place: The address, an argument of the kernel.
        reader: The function that returns the arrays from the address, for a name in the kernel that `Kernel.calling`
            replaces.
    """

    def __init__(self, *arrays: Array | Rows | tuple[Any, ...]) -> None:
        """Takes arrays and nested tuples of arrays.

        They are described as Numba does: owners (none), number of items, bytes of one, address, shape, strides.
        """
        self._arrays = arrays
        described = [(0, 0, a.size, a.itemsize, a.ctypes.data, *a.shape, *a.strides) for a in flat(arrays)]
        self._description = np.concatenate(described, dtype=np.intp)
        self.place: int = self._description.ctypes.data
        kinds = _kinds(arrays)
        if kinds not in _readers:
            from numba import typeof

            _readers[kinds] = _reader(typeof(arrays))  # which looks through every field of every record
        self.reader = _readers[kinds]


def flat(arrays: tuple[Any, ...]) -> list[NDArray[Any]]:
    """Returns the arrays of a nested tuple of arrays."""
    return [a for entry in arrays for a in (flat(entry) if isinstance(entry, tuple) else [entry])]


_readers: dict[tuple[Any, ...], Any] = {}
"""The reader of each kind of arrays."""


def _kinds(arrays: tuple[Any, ...]) -> tuple[Any, ...]:
    """Returns of each array of a nested tuple all that Numba's type of it depends on."""
    return tuple(
        (type(a), _kinds(a))
        if isinstance(a, tuple)
        else (a.dtype, a.dtype.isalignedstruct, a.ndim, a.flags.c_contiguous, a.flags.f_contiguous, a.flags.writeable)
        for a in arrays
    )


def held(place: int) -> tuple[Any, ...]:
    """Stands in a kernel for its arrays; the reader of a `Held` replaces it (`Kernel.calling`)."""
    raise NotImplementedError


@cache
def _calling(law: Callable[P, T], *laws: tuple[str, Any]) -> Kernel[P, T]:
    return Kernel(law, dict(laws))


@cache
def _reader(kinds: Any) -> Any:  # noqa: ANN401
    """Returns a function for kernels that takes an address, and returns the arrays of these types described there."""
    from numba.extending import intrinsic

    def arrays(context: Any, place: Any) -> Any:  # noqa: ANN401
        def read(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
            return builder.load(builder.inttoptr(arguments[0], target.get_value_type(kinds).as_pointer()))

        return kinds(place), read

    reader: Any = intrinsic(arrays)
    reader.kinds = kinds.name
    return reader


def _where_possible(save: Callable[..., None]) -> Callable[..., None]:
    """Returns what keeps machine code on disk as `save` does, but only warns where the disk is full."""

    def kept(*overload: Any) -> None:  # noqa: ANN401
        try:
            save(*overload)
        except OSError as error:
            again = "each program compiles them again, unless NUMBA_CACHE_DIR names another folder"
            warnings.warn(f"compiled laws cannot be kept on disk; {again}: {error.strerror or error}", stacklevel=2)

    return kept


def kernel(law: Callable[P, T]) -> Kernel[P, T]:
    """Decorates a function that is compiled when it is first called."""
    return Kernel(law)


@cache
def announced_early() -> bool:
    """Says that laws will be compiled, before the import of Numba and MuJoCo, which takes seconds, if none is on disk.

    Returns:
        Whether it was said. It is not where Numba is there already, nor where it would choose a folder of its own.
    """
    if "numba" in sys.modules:
        return False
    package = Path(__file__).parent
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or package)
    if (folder == package and not os.access(package, os.W_OK)) or any(folder.rglob("*.nbi")):
        return False
    print(COMPILING, file=sys.stderr, flush=True)
    return True


@cache
def kernel_files_digest() -> str:
    """Digest of every file of the package that holds a kernel."""
    found = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        text = path.read_bytes()
        if b"@kernel" in text:
            found.update(text)
    return found.hexdigest()


@cache
def _known_to_numba() -> None:
    """Tells Numba's compiler that a kernel which another kernel calls stands for its compiled function."""
    from numba.core import types
    from numba.extending import typeof_impl

    @typeof_impl.register(Kernel)
    def _(value: Kernel, context: object) -> types.Dispatcher:  # type: ignore[reportUnusedFunction]
        return types.Dispatcher(value.inlined)


@cache
def _compilers() -> tuple[Any, Any]:
    """Returns how Numba compiles kernels for calls from Python, and how for calls from other kernels.

    For Python it does so without the garbage collector, which would look through all that the compiler keeps, again and
    again. For other kernels it leaves a law as it is, for whoever calls it takes it in and is optimised as a whole.
    Numba by itself optimises it, and makes machine code of it, at each level of calls, in two fifths of the time.
    """
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler

    class ForPython(Compiler):
        def compile_extra(self, func: Any) -> Any:  # noqa: ANN401
            collects = gc.isenabled()
            gc.disable()
            try:
                return super().compile_extra(func)
            finally:
                if collects:
                    gc.enable()

    class ForKernels(Compiler):
        def define_pipelines(self) -> Any:  # noqa: ANN401
            state = self.state
            state.library = Lowered(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.enable_object_caching()
            return super().define_pipelines()

    class Lowered(JITCodeLibrary):
        def _optimize_final_module(self) -> None:
            self._finalized = True  # or the next line would finalise it, and so call this again
            self._get_module_for_linking()  # keeps a copy for the callers, as long as others can see the functions
            for function in self._final_module.functions:
                if not function.is_declaration:
                    function.linkage = "available_externally"  # of which no machine code is made

    return ForPython, ForKernels


def over_rows(law: Kernel, *arguments: Array | float) -> None:
    """Calls a law row by row, for the few callers that have arrays and no loop of their own to compile.

    Args:
        law: A law that writes its results into its arguments.
        arguments: Arrays with a leading axis of common length B, or scalars, which every row gets unchanged.
    """
    size = max(np.shape(a)[0] for a in arguments if np.ndim(a))
    for i in range(size):
        law.compiled(*[a[i] if np.ndim(a) else a for a in arguments])  # type: ignore[index]
