"""Containers of the tables of a case, and their places in it, through which they are changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TypedDict, TypeVar

if TYPE_CHECKING:
    from .schema import Case

__all__ = ["CaseTables", "KeyPath", "Place", "Rows", "Tables"]

KeyPath = tuple[str | int, ...]

V = TypeVar("V")


class CaseTables(TypedDict, total=False):
    """The tables that make a case, as nested tables with the keys of the case file, or as objects."""

    title: str
    mesh: Any
    node_set: Mapping[str, Any]
    material: Mapping[str, Any]
    section: Mapping[str, Any]
    initial: Any
    support: Iterable[Any]
    mass: Iterable[Any]
    spring: Iterable[Any]
    dashpot: Iterable[Any]
    load: Iterable[Any]
    gravity: Any
    wind: Any
    temperature: Iterable[Any]
    wall: Iterable[Any]
    contact_pair: Iterable[Any]
    constraint: Iterable[Any]
    remove: Iterable[Any]
    contact: Any
    time: Any
    static: Any
    stage: Iterable[Any]
    modes: Any
    output: Any
    solver: Any


class Place(NamedTuple):
    """Where a table is: the case that is changed with it, and its key path there."""

    case: Case
    path: KeyPath

    def change(self, key: str | int, value: Any) -> None:
        """Set a key of the table; see :meth:`~pfem_petsc.case.schema.Case.update`."""
        self.case.edit([((*self.path, key), value)])


class Tables(dict[str, V]):
    """Tables by name, such as the materials of a case; changes are validated at once."""

    __slots__ = ("_place",)
    _place: Place

    def __setitem__(self, name: str, table: Any) -> None:
        self._place.change(name, table)

    def __delitem__(self, name: str) -> None:
        if name not in self:
            raise KeyError(name)
        self._place.change(name, None)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)

    def pop(self, name: str, *default: Any) -> Any:
        """Remove a table and return it; ``default`` if there is none."""
        if name not in self and default:
            return default[0]
        table = self[name]
        del self[name]
        return table

    def update(self, *tables: Any, **named: Any) -> None:
        """Set several tables at once."""
        changes = dict(*tables, **named)
        self._place.case.edit([((*self._place.path, name), table) for name, table in changes.items()])

    def setdefault(self, name: str, table: Any = None) -> V:
        """Set a table unless there is one, and return it."""
        if name not in self:
            self[name] = table
        return self[name]

    def __ior__(self, tables: Mapping[str, Any]) -> Tables[V]:
        self.update(tables)
        return self

    def clear(self) -> None:
        """Remove all tables."""
        self._place.case.edit([(self._place.path, None)])

    def popitem(self) -> tuple[str, V]:
        """Remove the last table and return it with its name."""
        name = next(reversed(self))
        return name, self.pop(name)


class Rows(list[V]):
    """A list of tables, such as the walls of a case; changes are validated at once."""

    __slots__ = ("_place",)
    _place: Place

    def _assign(self, rows: Iterable[Any]) -> None:
        self._place.case.edit([(self._place.path, list(rows))])

    def __reduce__(self) -> tuple[Any, ...]:
        return list, (list(self),)

    def __setitem__(self, i: Any, row: Any) -> None:
        rows: list[Any] = list(self)
        rows[i] = row
        self._assign(rows)

    def __delitem__(self, i: Any) -> None:
        rows = list(self)
        del rows[i]
        self._assign(rows)

    def append(self, row: Any) -> None:
        """Add a table at the end."""
        self._assign([*self, row])

    def extend(self, rows: Iterable[Any]) -> None:
        """Add tables at the end."""
        self._assign([*self, *rows])

    def __iadd__(self, rows: Iterable[Any]) -> Rows[V]:
        self.extend(rows)
        return self

    def __imul__(self, n: Any) -> NoReturn:
        raise TypeError("tables of a case cannot be repeated")

    def insert(self, i: Any, row: Any) -> None:
        """Add a table before index ``i``."""
        rows: list[Any] = list(self)
        rows.insert(i, row)
        self._assign(rows)

    def pop(self, i: Any = -1) -> V:
        """Remove a table and return it."""
        row = self[i]
        del self[i]
        return row

    def remove(self, row: Any) -> None:
        """Remove the first table that is equal to ``row``."""
        del self[self.index(row)]

    def clear(self) -> None:
        """Remove all tables."""
        self._assign([])

    def reverse(self) -> None:
        """Reverse the order."""
        self._assign(reversed(list(self)))

    def sort(self, **how: Any) -> None:
        """Sort the tables."""
        self._assign(sorted(self, **how))
