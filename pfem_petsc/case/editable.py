"""The tables of a case as attributes that can be changed, each change being validated with the whole case."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ..errors import InputError
from . import settings as s
from . import tables as t
from .containers import KeyPath, Rows, Tables
from .editing import attribute_of, changed_data, copied, key_path, merge, merged_stages, settle
from .names import checked_name, nearest_key
from .reading import KEYS
from .stages import TABLES

if TYPE_CHECKING:
    from ..mechanics.materials.base import MaterialKeys
    from .base import ConstraintKeys, WallParameters

__all__ = ["Editable"]


class Editable:
    """Base of :class:`~pfem_petsc.case.schema.Case`: its tables, and how they are changed and copied.

    Attributes
    ----------
    fixed : whether it cannot be changed, as the case of a simulation
    editor : the case that is changed with this one, which is another for those of stages; and the key path of a table
    """

    from_dict: ClassVar[Callable[..., Any]]

    title: str
    name: str
    source: str
    folder: Path
    overrides: tuple[str, ...]
    mesh: t.Mesh
    node_set: Tables[t.NodeSet]
    material: Tables[MaterialKeys]
    section: Tables[t.Section]
    initial: Rows[t.Initial]
    support: Rows[t.Support]
    point_mass: Rows[t.NodalMass]
    spring: Rows[t.Spring]
    dashpot: Rows[t.Dashpot]
    gravity: t.Gravity | t.VaryingGravity | None
    wind: t.Wind | t.VaryingWind | None
    temperature: Rows[t.Temperature]
    wall: Rows[WallParameters]
    contact_pair: Rows[t.ContactPair]
    constraint: Rows[ConstraintKeys]
    remove: Rows[t.Remove]
    contact: s.ContactSettings
    time: s.Time | None
    static: s.Static | None
    stage: tuple[Self, ...]
    modes: s.Modes | None
    output: s.Output
    solver: s.Solver
    number: int
    given: tuple[str, ...]
    removes_bars: bool

    fixed: bool
    editor: tuple[Self, Callable[[str], KeyPath]]

    def __setattr__(self, key: str, value: Any) -> None:
        if key == "name":
            self.update({key: value})
            return
        known = [attribute_of(table) for table in KEYS]
        if key not in known:
            hint = "; nodal masses are point_mass" if key == "mass" else nearest_key(key, known)
            raise InputError(f"{self.source}: {key}: a case has no table of this name{hint}")
        self._edit({("mass" if key == "point_mass" else key,): value})

    def __delattr__(self, key: str) -> None:
        setattr(self, key, None)

    def _edit(self, changes: Mapping[KeyPath, Any]) -> None:
        """Make changes at key paths as of this case, which may be that of a stage: it is given whole tables itself."""
        owner, place = self.editor
        own = ("stage", self.number)
        placed: list[tuple[KeyPath, Any]] = []
        for path, value in changes.items():
            given = owner is not self and len(path) == 1 and path[0] in TABLES
            placed.append(((*own, *path) if given else (*place(str(path[0])), *path[1:]), value))
        owner.edit(placed)

    def edit(self, changes: Iterable[tuple[KeyPath, Any]]) -> None:
        """Make changes at key paths; :meth:`update` takes keys as strings.

        Raises
        ------
        InputError
            The case is unchanged.
        """
        self._check_not_fixed()
        new = type(self).from_dict(changed_data(self, changes), name=self.name, source=self.source, folder=self.folder)
        settle(self, attached=False)
        for key in (*map(attribute_of, KEYS), "removes_bars"):
            merging = merged_stages if key == "stage" else merge
            self.__dict__[key] = merging(self.__dict__[key], new.__dict__[key])
        settle(self)

    def _check_not_fixed(self) -> None:
        if self.fixed:
            raise InputError(
                f"{self.source}: the case of a simulation cannot be changed; change the case that it was made from, "
                "and make another simulation"
            )

    def update(self, changes: Mapping[str, Any] | None = None, /, **named: Any) -> None:
        """Make several changes, and validate them together.

        Parameters
        ----------
        changes : values by key, ``{"time.step": 1e-5, "wall[0].point": [0, 0, 1]}``; None removes a key
        named : values of top-level keys, as for the constructor: ``name="stiff"``, ``wall=[]``

        Raises
        ------
        InputError
            The case is unchanged.
        """
        values = {**(changes or {}), **named}
        of_stage = self.editor[0] is not self
        name = None if of_stage or "name" not in values else checked_name(values.pop("name"), self.source)
        self._check_not_fixed()
        if values:
            self._edit({key_path(self, key): value for key, value in values.items()})
        if name is not None:
            self.__dict__["name"] = name

    def copy(self, changes: Mapping[str, Any] | None = None, /, *, fixed: bool = False, **named: Any) -> Self:
        """Return a copy, with changes as for :meth:`update`; if ``fixed``, the copy cannot be changed."""
        made = copied(self)
        if self.number or self.editor[0] is not self:  # of a stage
            made.__dict__.update(number=0, given=())
        made.__dict__["fixed"] = False
        settle(made)
        made.update(changes, **named)
        made.__dict__["fixed"] = fixed
        return made

    def __copy__(self) -> Self:
        return self.copy()

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.copy()

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "editor"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        settle(self)
