"""Compilation of loops over bars and nodes by Numba, with a cache keyed by all that the machine code depends on."""

from __future__ import annotations

import functools
import hashlib
import importlib
import os
import pickle
import threading
import time
import warnings
from collections.abc import Callable
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core import errors, event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.cpu import CPUTargetOptions
from numba.core.dispatcher import Dispatcher
from numba.core.options import TargetOptions
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.extending import _Intrinsic, intrinsic, register_jitable


def code_digest(function: Callable[..., Any]) -> str:
    """Return a digest of the byte code of a function and of all functions, constants and record types it refers to.

    Machine code depends on nothing else in the program. Calls of compiled functions are followed too.
    """
    digest = _Digest()
    digest.add(function)
    return digest.hexdigest()


class _Digest:
    """Digest of objects that machine code can depend on, and of all objects that they refer to."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._seen: set[int] = set()
        self.hexdigest = self._digest.hexdigest

    def add(self, thing: Any) -> None:
        """Add a function, or an object that functions refer to."""
        update = self._digest.update
        if isinstance(thing, CodeType):
            self._add_code(thing)
        elif isinstance(thing, Dispatcher):
            self.add(thing.py_func)
        elif isinstance(thing, _Intrinsic):
            self.add(thing._defn)
        elif isinstance(thing, FunctionType):
            self._add_function(thing)
        elif isinstance(thing, np.ndarray):
            update(repr((thing.shape, thing.dtype)).encode() + thing.tobytes())
        elif isinstance(thing, ModuleType):
            update(thing.__name__.encode())
        elif isinstance(thing, type):
            update(repr((thing.__qualname__, getattr(thing, "_fields", ()))).encode())
            if thing.__module__.partition(".")[0] == __name__.partition(".")[0]:  # it may generate code
                for part in vars(thing).values():
                    if isinstance(part, FunctionType):
                        self._add_function(part)
        elif isinstance(thing, (tuple, list, frozenset)):
            for part in sorted(thing, key=repr) if isinstance(thing, frozenset) else thing:
                self.add(part)
        elif isinstance(thing, (bool, int, float, complex, str, bytes, type(None), type(...), np.generic)):
            update(repr(thing).encode())
        else:
            update(type(thing).__qualname__.encode())

    def _add_code(self, code: CodeType) -> None:
        self._digest.update(code.co_code)
        self._digest.update(repr((code.co_names, code.co_varnames, code.co_freevars)).encode())
        for constant in code.co_consts:
            self.add(constant)

    def _add_function(self, function: FunctionType) -> None:
        if id(function) in self._seen:
            return
        self._seen.add(id(function))
        self._add_code(function.__code__)
        for cell in function.__closure__ or ():
            self.add(cell.cell_contents)
        # sorted, because the order of a set of names differs between processes
        for name in sorted(_global_names(function.__code__)):
            if name in function.__globals__:
                self._digest.update(name.encode())
                self.add(function.__globals__[name])


def _global_names(code: CodeType) -> set[str]:
    """Return the names that a function and its nested functions may look up globally."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _global_names(constant)
    return names


# Neither contraction to fused multiply-add nor reassociation: the result of a loop must not depend on how it was
# compiled, alone or into the loop of batches, for one bar or for eight at once. Then a bar evaluated on two ranks has
# the same bits on both, and a restarted run is bitwise identical to an uninterrupted one (contraction would save 5 %).
# Assuming "no NaN" would hide divergence.
_FAST = {"nsz"}

CPUTargetOptions.noalias = TargetOptions.Mapping("noalias")  # a flag of Numba's own loops, which has no option

COMPILED = not numba.config.DISABLE_JIT
"""Whether loops are compiled, so that others can call them by their addresses."""

_FORMAT = 2  # of cached files

_LONGEST = 130  # characters in the names of cached files for a variant of a loop; file systems take 255 in all


def kernel(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:
    """Compile a loop; the machine code is cached on disk if a folder for it is writable. ``more`` options of Numba."""
    options: dict[str, Any] = {"fastmath": _FAST, "error_model": "numpy", "nogil": True, **more}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "no locator" not in str(error):
            raise
        _warn_once(
            "compiled code cannot be cached (neither the package folder nor the home folder is writable), so every "
            "start compiles again; set NUMBA_CACHE_DIR to a writable folder"
        )
        return numba.njit(**options)(function)
    cache = getattr(compiled, "_cache", None)
    file = getattr(cache, "_cache_file", None)
    if isinstance(cache, FunctionCache) and isinstance(file, IndexDataCacheFile):
        cache.__class__ = _Cache
        file.__class__ = _CacheFile
        file._function = function
        file._variant = _variant(function)
    _distinguish(function)
    return compiled


def _distinguish(function: Callable[..., Any]) -> None:
    """Give a closure a unique name.

    The names of functions in machine code are made of module, name, types and a count in the process that has compiled
    them. Closures of one place, such as the loops of two laws, could then have the same name in machine code of two
    processes. A third one that loads both from the cache would call one for the other.
    """
    if "<locals>" in function.__qualname__:
        function.__qualname__ += f".{code_digest(function)[:16]}"


@functools.cache
def _warn_once(text: str) -> None:
    """Warn once, because all loops share the folder of the cache."""
    warnings.warn(text, stacklevel=3)


def _variant(function: Callable[..., Any]) -> str:
    """Return the names of the functions in modules from which a loop was made: ``elastic.response-strain.green``.

    Laws that are made from others add the name of what makes them, ``base.damped``.
    """
    found: list[str] = []
    seen: set[int] = set()

    def walk(inner: Any) -> None:
        inner = getattr(inner, "py_func", inner)
        if not isinstance(inner, FunctionType) or id(inner) in seen:
            return
        seen.add(id(inner))
        if inner is not function and "<locals>" not in inner.__qualname__:
            found.append(f"{inner.__module__.rpartition('.')[2]}.{inner.__name__}")
            return
        package, _, module = inner.__module__.rpartition(".")
        maker = inner.__qualname__.partition(".")[0]
        if package.endswith(".materials") and f"{module}.{maker}" not in found:
            found.append(f"{module}.{maker}")
        for cell in inner.__closure__ or ():
            walk(cell.cell_contents)

    walk(function)
    text = "-".join(sorted(found))
    if len(text) <= _LONGEST:
        return text
    return f"{text[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function into the loops that call it, with the options of :func:`kernel`."""
    _distinguish(function)
    return register_jitable(fastmath=_FAST, error_model="numpy")(function)


def borrowing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function as :func:`inlined`, without counting references to arrays: for functions that neither make nor
    return arrays.

    Each slice of an array and each field of a tuple of arrays counts references otherwise, by atomic operations that
    take as long as several bars.
    """
    _distinguish(function)
    return register_jitable(fastmath=_FAST, error_model="numpy", _nrt=False)(function)


def borrowing_apart(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function as :func:`borrowing` that writes to no array that shares memory with another argument: loops
    over many arrays are vectorised only if their addresses need not be compared."""
    _distinguish(function)
    return register_jitable(fastmath=_FAST, error_model="numpy", _nrt=False, noalias=True)(function)


def borrowing_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop that others call by its address, see :func:`calls`, without counting references."""
    return kernel(function, _nrt=False)


def calls(result: types.Tuple) -> Callable[..., Any]:
    """Make a function ``call(address, arguments)`` for compiled loops that calls the machine code at an address with a
    tuple of arguments and returns its ``result``; an address among the arguments may stand for a pointer.

    A loop that calls others in this way does not depend on which they are, and is compiled once for all of them.
    """

    @intrinsic
    def call(typingctx: Any, address: Any, arguments: Any) -> Any:  # noqa: ARG001
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kinds, convention = signature.args[1].types, context.call_conv
            kind = convention.get_function_type(result, kinds)
            function = builder.inttoptr(values[0], kind.as_pointer())
            given = [builder.extract_value(values[1], k) for k in range(len(kinds))]
            _, found = convention.call_function(builder, function, result, kinds, given)
            return found

        if any(isinstance(kind, types.Integer) and kind != types.int64 for kind in arguments.types):
            raise errors.TypingError(f"integers must be of 64 bits and signed, not {arguments}")
        return result(types.int64, arguments), generate

    return call


def address_of(function: Callable[..., Any], kinds: tuple[types.Type, ...], result: types.Tuple) -> int:
    """Return the address of the machine code of a :func:`borrowing_kernel` for arguments of some types; the loop must
    be kept as long as it is used.

    Raises
    ------
    TypeError
        If its result is not the one that the caller reads.
    """
    function.compile(kinds)
    compiled = function.overloads[kinds]
    if compiled.signature.return_type != result:
        raise TypeError(f"{function.__name__} returns {compiled.signature.return_type}, not {result}")
    return compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)


@intrinsic
def _store(typingctx: Any, value: Any, room: Any) -> Any:  # noqa: ARG001
    """Write a tuple to the memory of an array."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind, array = signature.args
        place = context.make_array(array)(context, builder, values[1]).data
        builder.store(values[0], builder.bitcast(place, context.get_value_type(kind).as_pointer()))
        return context.get_dummy_value()

    return types.void(value, room), generate


def packed(value: tuple[Any, ...]) -> tuple[np.ndarray, types.Type]:
    """Return a tuple of arrays and numbers as it lies in the memory of compiled loops, int64, and the type of a pointer
    to it: loops that are called by their address read it there. Both must be kept as long as these loops use it."""
    kind, context = numba.typeof(value), cpu_target.target_context
    room = np.zeros(-(-context.get_abi_sizeof(context.get_value_type(kind)) // 8), dtype=np.int64)
    _write(value, room)
    return room, types.CPointer(kind)


class _Cache(FunctionCache):
    """Cache of one loop whose keys do not depend on the process.

    Numba's own key includes the pickled closure, which for functions of a closure within a closure differs between
    processes. The digest that stamps the index covers closures.
    """

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        return signature, codegen.magic_tuple()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load machine code as Numba does, but without what only compilation needs: implementations of all functions,
        whose modules take longer to import than everything else, and what others would inline."""
        rtsys.initialize(target_context)
        codegen = target_context.codegen()
        found = self._cache_file.load(self._index_key(sig, codegen))
        if found is None:
            return None
        *reduced, inlined_code, symbols = found
        _, _, (machine_code, _) = reduced[0]
        if b"_numba_hashsecret" in machine_code:  # of this process, which this module makes known to machine code
            importlib.import_module("numba.cpython.hashing")
        codegen._engine._defined_symbols |= symbols
        compiled = self._impl.rebuild(target_context, reduced)
        _parse_later(compiled.library, inlined_code)
        return compiled

    def _save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code as Numba does, but apart from the code that others inline, and without empty environments,
        whose modules each start would import."""
        if not self._impl.check_cachable(data):
            return
        self._impl.locator.ensure_cache_path()
        (name, kind, (machine_code, inlined_code)), *parts, environments = self._impl.reduce(data)
        library = name, kind, (machine_code, parse_assembly("").as_bitcode())
        kept = tuple(one for one in environments if one.consts)
        module = data.library._get_module_for_linking()
        named = (one for kind in (module.functions, module.global_variables) for one in kind)
        symbols = {one.name for one in named if not one.is_declaration}
        self._cache_file.save(self._index_key(sig, data.codegen), (library, *parts, kept, inlined_code, symbols))


def _parse_later(library: Any, code: bytes) -> None:
    """Give a library of machine code the code that others inline, which is parsed when one does."""

    def module() -> Any:
        del library._get_module_for_linking
        library._shared_module = parse_bitcode(code)
        return library._get_module_for_linking()

    library._get_module_for_linking = module


class _CacheFile(IndexDataCacheFile):
    """Index of the machine code of one loop on disk, valid for the byte code it was compiled from, in whatever file.

    Numba's own stamp is the time and size of the loop's file. It would keep machine code whose inlined functions have
    changed in other files, and discard it if only a comment has changed.
    """

    _function: Callable[..., Any]
    _variant: str = ""
    _digest: str | None = None

    @property
    def _index_path(self) -> str:
        # loops made by one function, for each law and strain measure, would otherwise overwrite each other
        return os.path.join(self._cache_path, self._named(self._index_name))

    @_index_path.setter
    def _index_path(self, path: str) -> None:
        """Accept Numba's path, which has no variant."""

    def _data_path(self, name: str) -> str:
        return os.path.join(self._cache_path, self._named(name))

    def _named(self, name: str) -> str:
        first, _, rest = name.partition(".")
        return f"{first}.{self._variant}.{rest}" if self._variant else name

    @property
    def _source_stamp(self) -> str:
        # computed late: when the loop is defined, functions below it in its file do not exist yet
        if self._digest is None:
            # the name distinguishes machine code from that of versions whose closures had names in common
            self._digest = f"{_FORMAT} {self._function.__qualname__} {code_digest(self._function)}"
        return self._digest

    @_source_stamp.setter
    def _source_stamp(self, stamp: Any) -> None:
        """Ignore Numba's own stamp."""

    def _load_index(self) -> dict[Any, str]:
        try:
            return super()._load_index()
        except (pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError, IndexError, ImportError):
            return {}  # truncated or damaged: compile again and overwrite

    def load(self, key: Any) -> Any:
        try:
            return super().load(key)
        except (pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError, IndexError, ImportError):
            return None

    def save(self, key: Any, data: Any) -> None:
        try:
            super().save(key, data)
        except OSError as error:
            _warn_once(f"compiled code cannot be kept for the next start: {error.strerror}")


class Compilation(event.Listener):
    """Context manager that reports loops compiled by this process, but not those loaded from the cache.

    Parameters
    ----------
    begun : called once, with the name of the loop that is compiled then; with ``patience``, in another thread
    took : called after each compilation, with its time [s]
    patience : time [s] of all compilations before ``begun`` is called; those that take less are not reported
    """

    def __init__(self, begun: Callable[[str], None], took: Callable[[float], None], patience: float = 0.0) -> None:
        self._begun, self._took = begun, took
        self._told = False
        self._nested = 0  # loops compiled for a loop that calls them
        self._begin = 0.0
        self._patience = patience
        self._timer: threading.Timer | None = None

    def __enter__(self) -> Compilation:
        event.register("numba:compile", self)
        return self

    def __exit__(self, *_: object) -> None:
        event.unregister("numba:compile", self)
        self._nested = 0
        self._stop_timer()

    def on_start(self, event: event.Event) -> None:
        """Handle the start of a compilation."""
        if self._nested == 0:
            self._begin = time.perf_counter()
            if not self._told:
                name = getattr(getattr(event.data.get("dispatcher"), "py_func", None), "__name__", "a loop")
                self._tell_later(name)
        self._nested += 1

    def _tell_later(self, name: str) -> None:
        if self._patience <= 0.0:
            self._tell_now(name)
            return
        self._timer = threading.Timer(self._patience, self._tell_now, (name,))
        self._timer.daemon = True
        self._timer.start()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()  # so that what it says comes before what follows
            self._timer = None

    def _tell_now(self, name: str) -> None:
        self._told = True
        self._begun(name)

    def on_end(self, event: event.Event) -> None:
        """Handle the end of a compilation, successful or not."""
        self._nested -= 1
        if self._nested == 0:
            seconds = time.perf_counter() - self._begin
            self._patience -= seconds
            self._stop_timer()
            self._took(seconds)


@kernel
def _write(value: Any, room: Any) -> None:
    _store(value, room)
