"""A case: the complete input of a simulation, read from a TOML file and validated before any work is done."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Unpack

from ..errors import InputError
from .builtin import built_in_path, read_text
from .checks import check_names
from .containers import CaseTables
from .editable import Editable
from .editing import attribute_of, settle
from .names import checked_name
from .overrides import apply_overrides
from .parsing import parse_toml
from .problems import Problems
from .reading import KEYS, read_tables
from .stages import stages_of
from .toml import plain, table_text
from .writing import tables_of

__all__ = ["Case"]


class Case(Editable):
    """A validated case. Created by :meth:`from_file` (or :meth:`load`), from its text, or from tables.

    ``Case(mesh=..., material={...}, section={...}, time={...})`` takes the tables of a case file, all at once as nested
    tables (``Case({...}, mesh=truss)``), or by name; the mesh may be a :class:`~pfem_petsc.mesh.truss.Truss`. NumPy
    numbers and arrays, tuples and paths are accepted for the TOML types.

    Its tables can be changed: ``case.time.step = 1e-5``, ``case.material["steel"].young_modulus = 2e11``,
    ``case.wall.append({...})``, ``case.gravity = None`` (no gravity). Each change is validated with the whole case; an
    :class:`~pfem_petsc.errors.InputError` with the message of a case file leaves the case as it was. :meth:`update`
    makes changes that are valid only together. A simulation has a copy of its case.

    Attributes
    ----------
    title : title of the case
    name : stem of the case file, or name of the built-in case
    source : file of the case as given, for messages
    folder : to which the case's relative file names refer
    overrides : texts ``KEY=VALUE`` that override its values
    mesh : :class:`~pfem_petsc.case.tables.Mesh`: generator with parameters, or file
    node_set, material, section : tables by name, in file order
    initial, support, load, temperature, wall, contact_pair, constraint, remove : lists of tables
    point_mass : list of tables ``[[mass]]``; spring, dashpot : lists of tables
    gravity, wind : :class:`~pfem_petsc.case.tables.Gravity`, :class:`~pfem_petsc.case.tables.Wind`, or None
    contact, output, solver : tables of :mod:`~pfem_petsc.case.settings`
    time, static, modes : what is computed, None for what is not; ``time`` and ``static`` exclude each other
    stage : the cases of its stages, empty for a case without them
    stages : the same, or the case itself
    number : of a stage among those of its case, from 0
    given : tables that a stage gives itself, and does not have from the stages before
    stressed : names of the sections whose prestress a stage gives itself
    removes_bars : whether bars are removed, in this or another stage

    Raises
    ------
    InputError
        Names all invalid keys.

    Notes
    -----
    ``Case.load`` is a constructor, ``case.load`` the list of loads: an instance's attribute hides the classmethod.
    """

    def __init__(
        self,
        tables: Mapping[str, Any] | None = None,
        /,
        *,
        name: str | None = None,
        source: str = "case",
        folder: str | Path = ".",
        overrides: Iterable[str] = (),
        **named: Unpack[CaseTables],
    ) -> None:
        given = {key: value for key, value in named.items() if value is not None}
        data = {} if tables is None else tables
        if isinstance(data, Mapping):
            mesh = given.pop("mesh", None)
            data = {**data, **given}
            made = Case.from_dict(data, name=name, source=source, folder=folder, overrides=overrides, mesh=mesh)
        else:
            made = Case.from_dict(data, source=source)
        self.__dict__.update(made.__dict__)
        settle(self)

    @classmethod
    def _of(cls, attributes: Mapping[str, Any], *, name: str, source: str, folder: Path) -> Case:
        """The case of tables that were read."""
        case = cls.__new__(cls)
        for key in KEYS:
            case.__dict__[attribute_of(key)] = attributes.get(key, ()) if key == "stage" else attributes[key]
        case.__dict__.update(
            name=name, source=source, folder=Path(folder), overrides=(), number=0, given=(), stressed=()
        )
        case.__dict__.update(removes_bars=any(entry.bars is not None for entry in case.remove), fixed=False)
        return case

    def __eq__(self, other: object) -> bool:
        """Compare the content, without name, source and folder."""
        return isinstance(other, Case) and self.to_dict() == other.to_dict()

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<Case {self.name}: {self.title}>"

    @property
    def stages(self) -> tuple[Case, ...]:
        """The successive analyses: the cases of the stages, or the case itself."""
        return self.stage or (self,)

    @property
    def every_wall(self) -> list[Any]:
        """The walls of all stages, one for each name: the first with that name."""
        named: dict[str, Any] = {}
        for stage in self.stages:
            named = {**{wall.name: wall for wall in stage.wall}, **named}
        return list(named.values())

    def holds(self, table: str) -> bool:
        """Whether a table keeps its state at the end of the previous stage."""
        return self.number > 0 and table not in self.given

    @property
    def end(self) -> float:
        """End of the analysis: a time [s], or a load factor; 0 without one."""
        if self.stage:
            return sum(stage.end for stage in self.stage)
        if self.time is not None:
            return self.time.end
        return getattr(self.static.parameters, "end", 0.0) if self.static is not None else 0.0

    @property
    def mass(self) -> str:
        """The mass matrix of the analysis, ``lumped`` or ``consistent``."""
        if self.stage:
            return self.stage[0].mass
        if self.time is not None:
            return self.time.mass
        return (self.modes is not None and self.modes.mass) or "lumped"

    @classmethod
    def load(cls, path_or_name: str | Path, overrides: Iterable[str] = (), *, mesh: Any = None) -> Case:
        """Read a case file, or a built-in case by its name.

        Parameters
        ----------
        path_or_name : TOML file, or name of a built-in case
        overrides : strings such as ``"time.step=1e-5"`` that override values of the file
        mesh : Truss that replaces the mesh of the file

        Raises
        ------
        InputError
            Names all invalid keys.
        """
        path = built_in_path(str(path_or_name)) or Path(path_or_name)
        named: dict[str, Any] = {"name": path.stem, "source": str(path), "overrides": overrides, "mesh": mesh}
        return cls.from_toml(read_text(path), path.parent, **named)

    from_file = load

    @classmethod
    def from_toml(
        cls,
        text: str,
        folder: str | Path = ".",
        *,
        name: str = "case",
        source: str = "case",
        overrides: Iterable[str] = (),
        mesh: Any = None,
    ) -> Case:
        """Read the text of a case; see :meth:`load`. The path of its mesh file is relative to ``folder``."""
        data = parse_toml(text, source)
        return cls.from_dict(data, name=name, source=source, folder=folder, overrides=overrides, mesh=mesh)

    @classmethod
    def from_dict(
        cls,
        data: Mapping[str, Any],
        *,
        name: str | None = None,
        source: str = "case",
        folder: str | Path = ".",
        overrides: Iterable[str] = (),
        mesh: Any = None,
    ) -> Case:
        """Validate a case given as nested tables with the keys of the case file; see :meth:`load`.

        NumPy numbers and arrays, tuples and paths are accepted for the TOML types. ``mesh.file`` is relative to
        ``folder``; ``name`` is the default folder of the results.
        """
        if not isinstance(data, Mapping):
            raise InputError(
                f"{source}: expected nested tables, got {data!r:.80}; Case.load reads a case file, "
                "Case.from_toml its text"
            )
        try:
            overrides = tuple(overrides)
            data = plain(dict(data), copied=bool(overrides))
            if mesh is not None:
                data["mesh"] = _with_arrays(data.get("mesh"), plain(mesh))
        except RecursionError as error:
            raise InputError(f"{source}: this is not a case: its lists or tables are nested too deep") from error
        problems = Problems(source, apply_overrides(data, overrides))
        attributes = read_tables(data, Path(folder), problems)
        check_names(attributes, data, problems)
        stages = []
        for stage in stages_of(data, problems) if "stage" in data else ():
            tables = read_tables(stage.data, Path(folder), stage.problems)
            check_names(tables, stage.data, stage.problems)
            stages.append((stage, tables))
        problems.raise_if_any()
        name = Path(source).stem if name is None else checked_name(name, source)
        attributes["title"] = name if attributes["title"] is None else attributes["title"]
        case = cls._of(attributes, name=name, source=source, folder=Path(folder))
        case.__dict__["overrides"] = overrides
        made = []
        for k, (stage, tables) in enumerate(stages):
            each = cls._of(tables, name=stage.name, source=f"{source}: stage[{k}]", folder=Path(folder))
            made.append(each)
            each.__dict__.update(title=attributes["title"], number=k, given=stage.given, overrides=overrides)
            each.__dict__["stressed"] = stage.stressed
        case.__dict__["stage"] = tuple(made)
        removes = any(each.removes_bars for each in (case, *made))
        for each in (case, *made):
            each.__dict__["removes_bars"] = removes
        settle(case)
        return case

    def to_dict(self) -> dict[str, Any]:
        """Return the case as nested tables with the keys of the case file and all defaults, without absent tables."""
        return tables_of(self)

    def to_toml(self) -> str:
        """Return the resolved case, with all defaults, as text from which :meth:`from_toml` reads an equal case."""
        return table_text(self.to_dict())


def _with_arrays(table: Any, mesh: Any) -> Any:
    """The table [mesh] with a truss instead of what it had; the truss must be that of its digest, if it has one."""
    if isinstance(table, Mapping) and "digest" in table and hasattr(mesh, "mesh_table"):
        return {**mesh.mesh_table, "digest": table["digest"]}
    return mesh
