"""Compilation of loops over bars and nodes by Numba, the folder of their machine code, reports while it lasts, and
records of arrays as arguments."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba import types
from numba.experimental import structref
from numba.extending import register_jitable

COMPILED = not numba.config.DISABLE_JIT
"""Whether loops are compiled."""

KERNELS: list[Any] = []
"""All compiled loops of this process."""

NEEDED = ()
"""Argument of a loop for a part of it that is needed; None for one that is not, which is not compiled. Closures would
not do: Numba does not find their machine code on disk if they contain other loops."""

_PACKAGE = Path(__file__).parents[1]

_KEPT = 6
"""Folders of machine code, of several versions, processors or installations of Numba, that are kept."""

# Neither contraction to fused multiply-add nor reassociation, but for the sums of add_freely: the result of a loop must
# not depend on how it was compiled, for one bar or for eight at once. Then a bar evaluated on two ranks has the same
# bits on both, and a restarted run is bitwise identical to an uninterrupted one (contraction would save 5 %).
# Assuming "no NaN" would hide divergence.
_OPTIONS = {"fastmath": {"nsz"}, "error_model": "numpy"}


def _contents(top: Path) -> Iterator[bytes]:
    """Read all Python files of a package."""
    for folder, folders, names in os.walk(top):
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        for name in sorted(names):
            if name.endswith(".py"):
                with open(f"{folder}/{name}", "rb", 0) as file:
                    yield file.read()


def digest(*texts: str | bytes) -> str:
    """Return a digest of some texts."""
    found = hashlib.sha256()
    for text in texts:
        found.update(text.encode() if isinstance(text, str) else text)
        found.update(b"\0")
    return found.hexdigest()[:16]


def _processor() -> str:
    """Return what the machine code for a processor depends on."""
    try:
        with Path("/proc/cpuinfo").open() as file:
            lines = file.read(1 << 14).partition("\n\n")[0].splitlines()
    except OSError:
        lines = []
    known = "vendor_id", "cpu family", "model", "flags", "Features", "CPU part"
    return "\n".join([platform.machine(), *(line for line in lines if line.partition("\t")[0] in known)])


def _find_folder() -> Path | None:
    """Return the folder of the machine code of these sources, by this Numba, for this processor.

    Numba's own keys do not contain the functions that a loop calls.
    """
    versions = numba.__version__, sys.version, _processor()
    name = f"pfem_petsc-{digest(*versions, *_contents(_PACKAGE))}"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    roots = [numba.config.CACHE_DIR] if numba.config.CACHE_DIR else [_PACKAGE / "__pycache__", home]
    for folder in (Path(root, name) for root in roots):
        try:
            fresh = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(1 << 12))
            os.utime(folder)
        except OSError:
            continue
        if fresh:
            _remove_old(folder.parent)
        return folder
    warnings.warn(
        "compiled code cannot be cached (neither the package folder nor the home folder is writable), so every start "
        "compiles again; set NUMBA_CACHE_DIR to a writable folder",
        stacklevel=2,
    )
    return None


def _remove_old(root: Path) -> None:
    """Remove the folders of machine code that were not used for the longest time."""
    used = {}
    for folder in root.glob("pfem_petsc-*"):
        try:
            used[folder] = folder.stat().st_mtime
        except FileNotFoundError:  # another rank has removed it
            continue
    for folder in sorted(used, key=used.__getitem__)[:-_KEPT]:
        shutil.rmtree(folder, ignore_errors=True)


_FOLDER = _find_folder() if COMPILED else None


def kernel(function: Callable[..., Any], first_class: bool = False, called: bool = True) -> Callable[..., Any]:
    """Compile a loop; the machine code is kept on disk if a folder for it is writable.

    Loops compile faster without code that is not needed: to call a ``first_class`` one by its address, see
    :func:`~pfem_petsc.mechanics.chunk_laws.first_class`, and for one that is ``called`` by Python.
    """
    if not COMPILED:
        return function
    _distinguish(function)
    given, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(_FOLDER or "")  # which Numba reads now
    wrappers = {"no_cfunc_wrapper": not first_class, "no_cpython_wrapper": not called}
    try:
        made = numba.njit(cache=_FOLDER is not None, nogil=True, **wrappers, **_OPTIONS)(function)
    finally:
        numba.config.CACHE_DIR = given
    KERNELS.append(made)
    return made


def law_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop that Python calls, and other loops by its address."""
    return kernel(function, first_class=True)


def addressed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop that only other loops call, by its address."""
    return kernel(function, first_class=True, called=False)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function into the loops that call it, with the options of :func:`kernel`."""
    _distinguish(function)
    return register_jitable(**_OPTIONS, no_cfunc_wrapper=True)(function)


@register_jitable(fastmath={"nsz", "reassoc"}, error_model="numpy", no_cfunc_wrapper=True)
def add_freely(total: float, value: float) -> float:
    """Return a sum whose additions a loop may reorder, and keep in vectors of partial sums: for sums of the history
    that one loop alone makes, and that nothing else depends on."""
    return total + value


def _distinguish(function: Callable[..., Any]) -> None:
    """Give a closure a name that contains a digest of what it is made of.

    Files and functions in machine code are named after modules, functions and types. Closures of one place, such as
    the loops of two laws, could otherwise have the same name in machine code of two processes, and a third one that
    loads both would call one for the other; and ranks that compile both at once would write to the same files.
    """
    if "<locals>" in function.__qualname__:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        function.__qualname__ += f".{digest(_described(function), *map(_described, cells))}"


def _described(thing: Any) -> str:
    """Return what the machine code of a closure depends on: names of functions, with a digest of files outside the
    package, or values."""
    if isinstance(thing, tuple):
        return f"({','.join(map(_described, thing))})"
    function = getattr(thing, "py_func", thing)
    if not isinstance(function, FunctionType):
        return repr(thing)
    path = Path(function.__code__.co_filename)
    line = function.__code__.co_firstlineno
    return f"{function.__module__}.{function.__qualname__}:{line}{'' if _PACKAGE in path.parents else _digest_of(path)}"


def _digest_of(path: Path) -> str:
    """Return a digest of a file, and of all others of its package if it belongs to one."""
    top = path
    while (top.parent / "__init__.py").exists():
        top = top.parent
    return digest(*(_contents(top) if top.is_dir() else [path.read_bytes()] if path.exists() else []))


def count_compiled() -> int:
    """Return how many loops this process has compiled, or begun to; those loaded from disk do not count."""
    return sum(sum(loop.stats.cache_misses.values()) for loop in KERNELS)


class Compilation:
    """Context manager that reports while this process compiles loops, but not when it loads them from disk.

    Another thread looks at intervals which loops are being compiled, so that times are known to these.

    Parameters
    ----------
    tell : called with the name of a loop that is being compiled, and the time [s] of all compilations so far: when
        that exceeds ``patience``, and again while compilations last, at intervals that grow to :data:`TELL_EVERY`
    took : called with times [s] in which loops were compiled
    patience : time [s] of all compilations that is not reported
    """

    def __init__(
        self, tell: Callable[[str, float], None], took: Callable[[float], None], patience: float = 0.0
    ) -> None:
        self._tell, self._took = tell, took
        self._total, self._next = 0.0, patience
        self._failed: dict[int, int] = {}  # compilations that ended by errors before
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Compilation:
        self._failed = {id(loop): _begun(loop) for loop in KERNELS}
        self._over.clear()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _watch(self) -> None:
        before = time.perf_counter()
        while not self._over.wait(LOOK_EVERY):
            now = time.perf_counter()
            names = [loop.py_func.__name__ for loop in tuple(KERNELS) if _begun(loop) > self._failed.get(id(loop), 0)]
            if names:
                self.look(names[0], now - before)
            before = now

    def look(self, name: str, seconds: float) -> None:
        """Take account of a loop that was compiled for some seconds."""
        self._total += seconds
        self._took(seconds)
        if self._total >= self._next:
            self._next = self._total + min(max(self._total, 1.0), TELL_EVERY)
            self._tell(name, self._total)


TELL_EVERY = 15.0
"""Most seconds of compilations between two reports of them."""

LOOK_EVERY = 0.2
"""Seconds from one look at what is being compiled to the next."""


def _begun(loop: Any) -> int:
    """Return how many compilations of a loop have begun, but not ended, or failed."""
    known = loop.stats
    return sum(known.cache_misses.values()) + sum(known.cache_hits.values()) - len(loop.signatures)


# Records of arrays that compiled loops take by reference. Numba passes a named tuple as all its numbers, seven for an
# array: functions that take a few of them take long to compile, and to call. A record that was made of one by
# :func:`by_reference` is passed as an address. Loops read both alike, by the names of the fields. An array of the
# record is changed in place; another one needs another record.


class _Kind(types.StructRef):
    """Type of a record by a name that is short however many records it consists of: names of functions contain it."""

    def __init__(self, fields: Any) -> None:
        super().__init__(fields)
        self.name = f"{type(self).__name__}.{digest(self.name)}"


def _unliteral(self: Any, fields: Any) -> tuple[tuple[str, Any], ...]:
    return tuple((name, types.unliteral(kind)) for name, kind in fields)


def record(cls: type) -> type:
    """Class decorator: let instances of a named tuple be taken by reference. Its module gets the type and the class of
    these, which machine code on disk refers to."""
    module, name = sys.modules[cls.__module__], cls.__name__
    of_module = {"__module__": cls.__module__}
    kind = structref.register(type(f"{name}Type", (_Kind,), {**of_module, "preprocess_fields": _unliteral}))
    proxy = type(f"{name}Reference", (structref.StructRefProxy,), of_module)
    structref.define_proxy(proxy, kind, cls._fields)
    for made in (kind, proxy):
        setattr(module, made.__name__, made)
    return cls


@cache
def _maker(cls: type) -> Any:
    proxy = getattr(sys.modules[cls.__module__], f"{cls.__name__}Reference")

    @kernel
    def make(*values):  # noqa: ANN002, ANN202 - compiled
        return proxy(*values)

    return make


def _is_same(one: Any, other: Any) -> bool:
    return one is other or (isinstance(one, float) and one == other)


class References:
    """Records of named tuples, one of each class, which are kept as long as their fields are the same objects."""

    def __init__(self) -> None:
        self._kept: dict[type, tuple[Any, Any]] = {}

    def of(self, values: Any) -> Any:
        """Return the record of a named tuple, with those of its fields whose classes are records too; anything else as
        it is."""
        cls = type(values)
        if not COMPILED or not hasattr(sys.modules[cls.__module__], f"{cls.__name__}Reference"):
            return values
        before, reference = self._kept.get(cls, (None, None))
        if before is None or not all(map(_is_same, before, values)):
            reference = _maker(cls)(*(self.of(value) if isinstance(value, tuple) else value for value in values))
            self._kept[cls] = values, reference
        return reference


def by_reference(values: Any) -> Any:
    """Return the record of a named tuple, see :meth:`References.of`."""
    return References().of(values)
