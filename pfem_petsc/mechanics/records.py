"""Records of arrays that compiled loops take by reference.

Numba passes a named tuple as all its numbers, seven for an array: functions that take a few of them take long to
compile, and to call. A record that was made of one by :func:`by_reference` is passed as an address. Loops read both
alike, by the names of the fields. An array of the record is changed in place; another one needs another record.
"""

from __future__ import annotations

import sys
from functools import cache
from typing import Any

from numba import types
from numba.experimental import structref

from .compiled import COMPILED, digest, kernel

__all__ = ["References", "by_reference", "record"]


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
