"""Compilation of loops over bars and nodes by Numba, with a cache keyed by all that the machine code depends on."""

from __future__ import annotations

import functools
import hashlib
import importlib
import operator
import os
import pickle
import sys
import threading
import time
import uuid
import warnings
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from llvmlite.binding import ObjectFileRef, add_symbol, parse_bitcode
from numba.core import errors, event, types
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import compile_result
from numba.core.cpu import CPUTargetOptions
from numba.core.dispatcher import Dispatcher
from numba.core.options import TargetOptions
from numba.core.registry import cpu_target
from numba.core.runtime import _nrt_python
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.extending import _Intrinsic, intrinsic, register_jitable

TELL_EVERY = 15.0
"""Most seconds of compilations between two reports of them."""


def code_digest(function: Callable[..., Any]) -> str:
    """Return a digest of the byte code of a function and of all functions, constants and record types it refers to.

    Machine code depends on nothing else in the program. Calls of compiled functions are followed too.
    """
    numbers: dict[FunctionType, int] = {}
    digest = hashlib.sha256()
    following = [getattr(function, "py_func", function)]
    while following:
        one = following.pop()
        if one not in numbers:
            numbers[one] = len(numbers)
            own, others = _part(one)
            digest.update(own)
            following += reversed(others)
        digest.update(b"%d" % numbers[one])
    return digest.hexdigest()


_parts: dict[FunctionType, tuple[list[Any], bytes, list[FunctionType]]] = {}


def _part(function: FunctionType) -> tuple[bytes, list[FunctionType]]:
    """Return a digest of a function without those that it refers to, and these.

    It is kept with the values of all names, some of which are defined or replaced later.
    """
    names = _global_names(function.__code__)
    values = [function.__globals__.get(name) for name in names]
    values += [cell.cell_contents for cell in function.__closure__ or ()]
    kept = _parts.get(function)
    if kept is None or not all(map(operator.is_, kept[0], values)):
        digest = _Digest()
        digest.add(function.__code__)
        for cell in function.__closure__ or ():
            digest.add(cell.cell_contents)
        for name in names:
            if name in function.__globals__:
                digest.update(name.encode())
                digest.add(function.__globals__[name])
        kept = _parts[function] = values, digest.digest(), digest.functions
    return kept[1:]


class _Digest:
    """Digest of objects that machine code can depend on; ``functions`` are those found among them."""

    def __init__(self) -> None:
        digest = hashlib.sha256()
        self.update, self.digest = digest.update, digest.digest
        self.functions: list[FunctionType] = []

    def add(self, thing: Any) -> None:
        """Add an object that functions refer to."""
        update = self.update
        # the most frequent ones first
        if isinstance(thing, (bool, int, float, complex, str, bytes, type(None), type(...), np.generic)):
            update(repr(thing).encode())
        elif isinstance(thing, FunctionType):
            update(b"function")
            self.functions.append(thing)
        elif isinstance(thing, CodeType):
            update(thing.co_code)
            update(repr((thing.co_names, thing.co_varnames, thing.co_freevars)).encode())
            self.add(thing.co_consts)
        elif isinstance(thing, np.ndarray):
            update(repr((thing.shape, thing.dtype)).encode() + thing.tobytes())
        elif isinstance(thing, ModuleType):
            update(thing.__name__.encode())
        elif isinstance(thing, type):
            update(repr((thing.__qualname__, getattr(thing, "_fields", ()))).encode())
            if thing.__module__.partition(".")[0] == __name__.partition(".")[0]:  # it may generate code
                for part in vars(thing).values():
                    if isinstance(part, FunctionType):
                        self.add(part)
        elif isinstance(thing, (tuple, list, frozenset)):
            for part in sorted(thing, key=repr) if isinstance(thing, frozenset) else thing:
                self.add(part)
        elif isinstance(thing, Dispatcher):
            self.add(thing.py_func)
        elif isinstance(thing, _Intrinsic):
            self.add(thing._defn)
        else:
            update(type(thing).__qualname__.encode())


@functools.cache
def _global_names(code: CodeType) -> tuple[str, ...]:
    """Return the names that a function and its nested functions may look up globally, sorted: the order of a set of
    names differs between processes."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= set(_global_names(constant))
    return tuple(sorted(names))


# Neither contraction to fused multiply-add nor reassociation: the result of a loop must not depend on how it was
# compiled, alone or into the loop of batches, for one bar or for eight at once. Then a bar evaluated on two ranks has
# the same bits on both, and a restarted run is bitwise identical to an uninterrupted one (contraction would save 5 %).
# Assuming "no NaN" would hide divergence.
_FAST = {"nsz"}

CPUTargetOptions.noalias = TargetOptions.Mapping("noalias")  # a flag of Numba's own loops, which has no option

COMPILED = not numba.config.DISABLE_JIT
"""Whether loops are compiled, so that others can call them by their addresses."""

_FORMAT = 3  # of cached files

_DAMAGED = (pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError, IndexError, ImportError, KeyError)

_LONGEST = 130  # characters in the names of cached files for a variant of a loop; file systems take 255 in all


def kernel(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:
    """Compile a loop; the machine code is cached on disk if a folder for it is writable. ``more`` options of Numba."""
    options: dict[str, Any] = {"fastmath": _FAST, "error_model": "numpy", "nogil": True, **more}
    compiled = numba.njit(**options)(function)
    if isinstance(compiled, Dispatcher):
        compiled._cache = _Cache(function)
        # types of other packages, which the arguments are not of; a compilation looks for them itself
        compiled._compilation_chain_init_hook = _without_extensions
    _distinguish(function)
    return compiled


def _without_extensions() -> None:
    """Look for no extensions of Numba in all installed packages."""


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


@register_jitable(fastmath=_FAST | {"reassoc"}, error_model="numpy")
def add_freely(total: float, value: float) -> float:
    """Return a sum whose additions a loop may reorder, and keep in vectors of partial sums: for sums of the history
    that one loop alone makes, and that nothing else depends on."""
    return total + value


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


def generate_call(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Generate a call of a C function at an address with numbers, handles, which are pointers or integers of the same
    size, and pointers to arrays; for an intrinsic, whose first argument is the address."""
    address, *given = values
    arguments = [
        builder.bitcast(context.make_array(kind)(context, builder, value).data, ir.IntType(8).as_pointer())
        if isinstance(kind, types.Array)
        else value
        for kind, value in zip(signature.args[1:], given, strict=True)
    ]
    result = context.get_value_type(signature.return_type)
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(builder.inttoptr(address, kind.as_pointer()), arguments)


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


class _Cache:
    """Cache of one loop on disk, in place of Numba's.

    A file holds the machine code for one signature and processor, which its name has a digest of. It begins with a
    stamp of all else that the machine code depends on: Numba's own, the time and size of the loop's file, would keep
    machine code whose inlined functions have changed in other files, and discard it if only a comment has changed.
    Where files may be is looked up late, for most loops of a program are not called.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._name = f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"

    @functools.cached_property
    def _impl(self) -> CompileResultCacheImpl | None:
        try:
            return CompileResultCacheImpl(self._function)
        except RuntimeError as error:
            if "no locator" not in str(error):
                raise
            _warn_once(
                "compiled code cannot be cached (neither the package folder nor the home folder is writable), so every "
                "start compiles again; set NUMBA_CACHE_DIR to a writable folder"
            )
            return None

    @functools.cached_property
    def stamp(self) -> bytes:
        """Digest of the loop, of what it calls and of Numba."""
        # computed late: when the loop is defined, functions below it in its file do not exist yet
        # the name distinguishes machine code from that of versions whose closures had names in common
        text = f"{_FORMAT} {numba.__version__} {self._function.__qualname__} {code_digest(self._function)}"
        return hashlib.sha256(text.encode()).digest()

    @functools.cached_property
    def base(self) -> str:
        """Path of the files of this loop without the digest of a signature."""
        # loops made by one function, for each law and strain measure, would otherwise overwrite each other
        variant = _variant(self._function)
        first, _, rest = self._impl.get_filename_base(self._name, sys.abiflags).partition(".")
        name = f"{first}.{variant}.{rest}" if variant else f"{first}.{rest}"
        return os.path.join(self._impl.locator.get_cache_path(), name)

    def path(self, sig: Any, codegen: Any) -> str:
        """Return the path of the file of a signature."""
        key = hashlib.sha256(repr((sig, _processor(codegen))).encode()).hexdigest()
        return f"{self.base}.{key[:16]}.nbc"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load machine code as Numba does, but without what only compilation needs: implementations of all functions,
        whose modules take longer to import than everything else, and what others would inline."""
        if self._impl is None:
            return None
        codegen = target_context.codegen()
        try:
            content = Path(self.path(sig, codegen)).read_bytes()
            if content[: len(self.stamp)] != self.stamp:
                return None
            found = pickle.loads(memoryview(content)[len(self.stamp) :])
        except (OSError, *_DAMAGED):
            return None  # missing, truncated or damaged: compile again and overwrite
        signature, fndesc, environments, reload_init, *code = found
        if signature.args != normalize_signature(sig)[0]:
            return None
        for function in reload_init:
            function()
        library = _Loaded(codegen, *code)
        own, *others = environments
        entry = target_context.get_executable(library, fndesc, own)
        for one in others:
            codegen.set_env(one.env_name, one)
        return compile_result(
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=library,
            environment=own,
            entry_point=entry,
            fndesc=fndesc,
            signature=signature,
            objectmode=False,
            lifted=(),
            reload_init=reload_init,
            referenced_envs=others,
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code, what others inline, and the environments that are not empty, whose modules each start
        would import."""
        if self._impl is None or not self._impl.check_cachable(data):
            return
        (name, _, code), fndesc, own, signature, *_, reload_init, environments = self._impl.reduce(data)
        kept = [own, *(one for one in environments if one.consts)]
        module = data.library._get_module_for_linking()
        named = (one for kind in (module.functions, module.global_variables) for one in kind)
        symbols = {one.name for one in named if not one.is_declaration}
        content = self.stamp + dumps((signature, fndesc, kept, reload_init, name, *code, symbols))
        path = self.path(sig, data.codegen)
        try:
            self._impl.locator.ensure_cache_path()
            temporary = Path(f"{path}.tmp.{uuid.uuid4().hex[:16]}")
            try:
                temporary.write_bytes(content)
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)
        except OSError as error:
            _warn_once(f"compiled code cannot be kept for the next start: {error.strerror}")


@functools.cache
def _processor(codegen: Any) -> tuple[Any, ...]:
    return codegen.magic_tuple()


class _Loaded(JITCodeLibrary):
    """Machine code of a file, which goes to LLVM as it is; what others inline is parsed when one does."""

    _finalized = _disable_inspection = True

    def __init__(self, codegen: Any, name: str, machine_code: bytes, inlined_code: bytes, symbols: set[str]) -> None:
        CodeLibrary.__init__(self, codegen, name)
        _make_runtime_known()
        if b"_numba_hashsecret" in machine_code:  # of this process, which this module makes known to machine code
            importlib.import_module("numba.cpython.hashing")
        codegen._engine._ee.add_object_file(ObjectFileRef.from_data(machine_code))
        codegen._engine._defined_symbols |= symbols
        self._inlined_code = inlined_code

    def _get_module_for_linking(self) -> Any:
        return self._module

    @functools.cached_property
    def _module(self) -> Any:
        return parse_bitcode(self._inlined_code)


@functools.cache
def _make_runtime_known() -> None:
    """Make the functions for Numba's arrays known to machine code; those that compilation needs are not compiled."""
    for name, address in _nrt_python.c_helpers.items():
        add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class Compilation(event.Listener):
    """Context manager that reports loops compiled by this process, but not those loaded from the cache.

    Parameters
    ----------
    tell : called with the name of the loop that is being compiled, and the time [s] of all compilations so far: when
        that exceeds ``patience``, and again while compilations last, at intervals that grow to :data:`TELL_EVERY`;
        mostly in another thread
    took : called after each compilation, with its time [s]
    patience : time [s] of all compilations that is not reported
    """

    def __init__(
        self, tell: Callable[[str, float], None], took: Callable[[float], None], patience: float = 0.0
    ) -> None:
        self._tell, self._took = tell, took
        self._names: list[str] = []  # of the loops being compiled, each for the one before it that calls it
        self._begin = self._total = 0.0
        self._next = patience
        self._timer: threading.Timer | None = None

    def __enter__(self) -> Compilation:
        event.register("numba:compile", self)
        return self

    def __exit__(self, *_: object) -> None:
        event.unregister("numba:compile", self)
        self._names.clear()
        self._stop_timer()

    def on_start(self, event: event.Event) -> None:
        """Handle the start of a compilation."""
        loop = event.data.get("dispatcher")
        given = [each.dispatcher for each in event.data.get("args") or () if isinstance(each, types.Dispatcher)]
        if loop is _write and given:  # a loop that is called by its address
            loop = given[0]
        self._names.append(getattr(getattr(loop, "py_func", None), "__name__", "a loop"))
        if len(self._names) == 1:
            self._begin = time.perf_counter()
            self._wait()

    def _wait(self) -> None:
        """Tell the loop now if it is time to, and later if the compilation lasts so long."""
        so_far = self._total + time.perf_counter() - self._begin
        if so_far >= self._next:
            self._next = so_far + min(max(so_far, 1.0), TELL_EVERY)
            self._tell("".join(self._names[:1]), so_far)
        timer = threading.Timer(self._next - so_far, self._wait)
        timer.daemon = True
        timer.start()
        self._timer = timer

    def _stop_timer(self) -> None:
        while self._timer is not None:
            timer, self._timer = self._timer, None
            timer.cancel()
            timer.join()  # so that what it says comes before what follows

    def on_end(self, event: event.Event) -> None:
        """Handle the end of a compilation, successful or not."""
        self._names.pop()
        if not self._names:
            self._stop_timer()
            seconds = time.perf_counter() - self._begin
            self._total += seconds
            self._took(seconds)


@kernel
def _write(value: Any, room: Any) -> None:
    _store(value, room)
