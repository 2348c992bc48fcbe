"""A case: the complete input of a simulation, read from a TOML file and validated before any work is done."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from ..errors import InputError
from ..mechanics.materials.base import law_of
from ..registry import add_plugin, has_plugin, nearest
from . import load_cases
from .base import is_finite_number
from .editing import (
    TABLES,
    apply_overrides,
    attribute_of,
    changed_data,
    key_path,
    merge,
    merged_stages,
    settle,
    tables_of,
)
from .model import ANALYSES, KEYS, ONE_STAGE, STAGE_TABLES, CaseModel, Reading, StageName, StageOutput
from .problems import Problems
from .tables import PRESTRESSES, Damping
from .toml import KeyPath, built_in_path, key_text, parse_toml, plain, read_text, table_text

NAMED = ("node_set", "material", "section")
"""Keys that have tables by name."""

_WITHOUT_STAGES = {
    **dict.fromkeys(("stage", "given", "stressed"), ()),
    "number": 0,
    "fixed": False,
    "derived": False,
    "starts_from": None,
}
"""Attributes of a case that is no stage."""

_ARGUMENTS = {
    "name": "the name of a case is that of its file, or an argument: Case(..., name=...), case.copy(name=...)",
    "source": "it is an argument of Case(...) and cannot be changed",
    "folder": "it is an argument of Case(...) and cannot be changed",
    "overrides": "it is an argument of Case(...) and cannot be changed; update and copy take changes by key",
    "comment": "comments of TOML begin with #",
}

if TYPE_CHECKING:
    _Tables = CaseModel  # for checkers of types: a case has the attributes of the model
else:
    _Tables = object


class Case(_Tables):
    """A validated case. Created by :meth:`load` from a file, from its text, or from tables.

    ``Case(mesh=..., material={...}, section={...}, time={...})`` takes the tables of a case file, all at once as nested
    tables (``Case({...}, mesh=truss)``), or by name; the mesh may be a ``Truss``. NumPy
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
    added : files of plugins that were given in addition to its own
    mesh : :class:`~pfem_petsc.case.model.Mesh`: generator with parameters, or file
    node_set, material, section : tables by name, in file order
    initial, support, load, temperature, wall, contact_pair, constraint, remove : lists of tables
    point_mass : list of tables ``[[mass]]``; spring, dashpot : lists of tables
    gravity, wind, self_contact : :class:`~pfem_petsc.case.tables.Gravity`, :class:`~pfem_petsc.case.tables.Wind`,
        :class:`~pfem_petsc.case.tables.SelfContact`, or None
    contact, output, solver : tables of :mod:`~pfem_petsc.case.tables`
    time, static, modes : what is computed, None for what is not; ``time`` and ``static`` exclude each other
    stage : the cases of its stages, empty for a case without them
    stages : the same, or the case itself
    number : of a stage among those of its case, from 0
    given : tables that a stage gives itself, and does not have from the stages before
    stressed : names of the sections whose prestress a stage gives itself
    derived : whether a stage follows from load cases, and is not one of ``[[stage]]``
    starts_from : number of the stage from whose end a load case or combination starts; None: the one before
    fixed : whether it cannot be changed, as the case of a simulation
    editor : the case that is changed with this one, which is another for those of stages; and the key path of a table

    Raises
    ------
    InputError
        Names all invalid keys.

    Notes
    -----
    ``Case.load`` is a constructor, ``case.load`` the list of loads: an instance's attribute hides the classmethod.
    :meth:`from_file` is another name of it.
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
        **named: Any,
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
    def _of(cls, model: CaseModel, **attributes: Any) -> Case:
        case = cls.__new__(cls)
        case.__dict__.update({attribute_of(key): value for key, value in model.__dict__.items()})
        case.__dict__.update(_WITHOUT_STAGES | attributes)
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

    @property
    def removes_bars(self) -> bool:
        """Whether bars are removed, in this or another stage."""
        whole = self.editor[0]
        return any(entry.bars is not None for each in (whole, *whole.stage) for entry in each.remove)

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
    def load(
        cls, path_or_name: str | Path, overrides: Iterable[str] = (), *, mesh: Any = None, plugins: Iterable[Any] = ()
    ) -> Case:
        """Read a case file, or a built-in case by its name.

        Parameters
        ----------
        path_or_name : TOML file, or name of a built-in case
        overrides : strings such as ``"time.step=1e-5"`` that override values of the file
        mesh : Truss that replaces the mesh of the file
        plugins : files with modules, in addition to those of the case; relative to the working directory

        Raises
        ------
        InputError
            Names all invalid keys.
        """
        path = built_in_path(str(path_or_name)) or Path(path_or_name)
        named: dict[str, Any] = {"name": path.stem, "source": str(path), "overrides": overrides, "mesh": mesh}
        return cls.from_dict(parse_toml(read_text(path), str(path)), folder=path.parent, plugins=plugins, **named)

    from_file = load
    """Another name."""

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
        lenient: bool = False,
    ) -> Case:
        """Read the text of a case; see :meth:`load`. The path of its mesh file is relative to ``folder``.

        If ``lenient``, as for the case of a result, plugins are not run, and what is missing is a warning.
        """
        data, keys = parse_toml(text, source), {"overrides": overrides, "mesh": mesh, "lenient": lenient}
        return cls.from_dict(data, name=name, source=source, folder=folder, **keys)

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
        plugins: Iterable[str | Path] = (),
        lenient: bool = False,
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
            data = plain(data)
            if mesh is not None:
                data["mesh"] = _with_arrays(data.get("mesh"), plain(mesh))
        except RecursionError as error:
            raise InputError(f"{source}: this is not a case: its lists or tables are nested too deep") from error
        overrides, folder = tuple(overrides), Path(folder)
        named = {key: list(table) for key, table in data.items() if key in NAMED and isinstance(table, Mapping)}
        problems = Problems(source, apply_overrides(data, overrides), named)
        added = tuple(str(Path(each).resolve()) for each in plugins)
        if added:
            own = data.get("plugins", [])
            data["plugins"] = [*(own if isinstance(own, list) else [own]), *added]
        _spread_damping(data, problems)
        stages = stages_of(data, problems) if "stage" in data else []
        if not lenient:
            _add_plugins(data.get("plugins"), folder, problems)
        reading: list[Reading] = []

        def validated(tables: Mapping[str, Any], place: Callable[[KeyPath], KeyPath] = tuple) -> Any:
            reading.append(Reading(tables, folder, lenient))
            return _validated(tables, reading[-1], problems, place)

        model, models = validated(data), [validated(stage.data, stage.place) for stage in stages]
        if model is not None and None not in models and (model.load_case or model.combination):
            derived = load_case_stages(data, model, stages, [model, *models][-1], problems)
            models += [validated(stage.data, stage.place) for stage in derived]
            stages += derived
        if model is not None and None not in models and not lenient:
            _check_sections(model, models, problems)
        problems.raise_if_any()
        missing = dict.fromkeys(text for each in reading for text in each.missing)
        if missing:
            warnings.warn(
                f"{source}: parts of the case are unknown: {', '.join(missing)}; what depends on them is left out. "
                "Name the files that define them by --plugin, or install their packages",
                stacklevel=2,
            )
        name = Path(source).stem if name is None else _checked_name(name, source)
        title = name if model.title is None else model.title
        common = {"title": title, "folder": folder, "overrides": overrides, "added": added}
        case = cls._of(model, name=name, source=source, **common)
        case.__dict__["stage"] = tuple(
            cls._of(
                tables,
                name=stage.name,
                source=": ".join(filter(None, (source, key_text(stage.of if stage.derived else ("stage", k))))),
                number=k,
                given=stage.given,
                stressed=stage.stressed,
                derived=stage.derived,
                starts_from=stage.starts_from,
                **common,
            )
            for k, (stage, tables) in enumerate(zip(stages, models, strict=True))
        )
        settle(case)
        return case

    def to_dict(self) -> dict[str, Any]:
        """Return the case as nested tables with the keys of the case file and all defaults, without absent tables."""
        return tables_of(self)

    def to_toml(self) -> str:
        """Return the resolved case, with all defaults, as text from which :meth:`from_toml` reads an equal case."""
        return table_text(self.to_dict())

    def __setattr__(self, key: str, value: Any) -> None:
        if key == "name":
            self.update({key: value})
            return
        known = [attribute_of(table) for table in KEYS]
        if key not in known:
            hint = "; nodal masses are point_mass" if key == "mass" else _hint(key, known)
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
            given = owner is not self and len(path) == 1 and path[0] in STAGE_TABLES
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
        new = self._reread(changed_data(self, changes))
        settle(self, attached=False)
        for key in ("title", "plugins", *TABLES.values()):
            self.__dict__[key] = merge(self.__dict__[key], new.__dict__[key])
        self.__dict__["stage"] = merged_stages(self.stage, new.stage)
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
        name = None if of_stage or "name" not in values else _checked_name(values.pop("name"), self.source)
        self._check_not_fixed()
        if values:
            self._edit({key_path(self, key): value for key, value in values.items()})
        if name is not None:
            self.__dict__["name"] = name

    def copy(self, changes: Mapping[str, Any] | None = None, /, *, fixed: bool = False, **named: Any) -> Self:
        """Return a copy, with changes as for :meth:`update`; if ``fixed``, the copy cannot be changed."""
        made = self._reread(tables_of(self, given=True))
        made.__dict__.update({"overrides": self.overrides, "added": self.added})
        made.update(changes, **named)
        made.__dict__["fixed"] = fixed
        return made

    def _reread(self, tables: Mapping[str, Any]) -> Case:
        return type(self).from_dict(tables, name=self.name, source=self.source, folder=self.folder)

    def __copy__(self) -> Self:
        return self.copy()

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        """The plugins are added before what they have is read."""
        state = {key: value for key, value in self.__dict__.items() if key != "editor"}
        plugins = [path for path in self.plugins if has_plugin(path)]  # not those of a result, whose case is lenient
        return _unpickled, (type(self), plugins, pickle.dumps(state))


def _with_arrays(table: Any, mesh: Any) -> Any:
    """The table [mesh] with a truss instead of what it had; the truss must be that of its digest, if it has one."""
    if isinstance(table, Mapping) and "digest" in table and hasattr(mesh, "mesh_table"):
        return {**mesh.mesh_table, "digest": table["digest"]}
    return mesh


def _unpickled(cls: type[Case], plugins: Iterable[str], state: bytes) -> Case:
    for path in plugins:
        add_plugin(path)
    case = cls.__new__(cls)
    case.__dict__.update(pickle.loads(state))
    settle(case)
    return case


def _spread_damping(data: dict[str, Any], problems: Problems) -> None:
    """Give each material and nodal mass its part of the table [damping], in the place of that table."""
    if "damping" not in data:
        return
    table = problems.validated(Damping, data.pop("damping"), None, lambda path: ("damping", *path))
    materials = data.get("material")
    if table is None or not isinstance(materials, Mapping):
        return
    of_mass, of_stiffness = table.factors
    for name, material in materials.items():
        if not isinstance(material, dict):
            continue
        for key in ("damping", "stiffness_damping"):
            text = "[damping] gives each material its damping: remove this key, or that table"
            if material.get(key):
                problems.add(("material", name, key), text, material.get(key))
        density = material.get("density")
        if is_finite_number(density):  # else it is refused
            material |= {"damping": of_mass * density, "stiffness_damping": of_stiffness}
    for row in data["mass"] if isinstance(data.get("mass"), list) else ():
        if isinstance(row, dict):
            row.setdefault("damping", of_mass)


def _validated(
    data: Mapping[str, Any], reading: Reading, problems: Problems, place: Callable[[KeyPath], KeyPath] = tuple
) -> Any:
    """Return the model of nested tables; if they are rejected, add the problems and return None."""
    for key in [key for key in data if key not in KEYS]:
        problems.add((key,), f"unknown key{_hint(key, [*KEYS, 'damping'])}")
    for key in ("material", "section"):
        if data.get(key, {}) == {}:
            problems.add((), f"no [{key}.NAME] is given: a case needs at least one {key}")
    if all(key in data for key in ANALYSES):
        problems.add((), "[time] and [static] exclude each other: give one of them")
    if not any(key in data for key in (*ANALYSES, "stage", "modes")):
        problems.add((), "the table [time] is missing, or one of [static], [[stage]], [modes], which give the analysis")
    # [[stage]] is checked by stages_of, which refuses an analysis beside it
    elsewhere = ("stage", *ANALYSES) if "stage" in data else ()
    known = {key: value for key, value in data.items() if key in KEYS and value is not None and key not in elsewhere}
    return problems.validated(CaseModel, known, reading, place)


def _check_sections(model: CaseModel, stages: list[CaseModel], problems: Problems) -> None:
    """Refuse keys of sections that would have no effect."""
    wind = any(each.wind is not None for each in (model, *stages))
    for name, section in model.section.items():
        for key in ("drag_coefficient",) if section.shape is not None else ("diameter", "drag_coefficient"):
            text, value = "has an effect in wind alone: remove the key, or give [wind]", getattr(section, key)
            if value is not None and not wind:
                problems.add(("section", name, key), text, value)
        material = model.material.get(section.material)
        if material is None or law_of(material).bar_data:  # whose law may use the shape
            continue
        warned = not material.describes_buckling and (section.shape is not None or section.second_moment is not None)
        if section.effective_length != 1.0 and not warned:
            problems.add(
                ("section", name, "effective_length"),
                "has no effect: bars of this material and section are not checked for buckling; remove the key",
                section.effective_length,
            )
        path = ("section", name, "thickness")
        follows = section.area is None and section.area_field is None  # from the sizes
        if path in problems.overridden and not follows and not wind:
            problems.add(
                path,
                "changes no result: stiffness and mass follow from area, and the law does not buckle; change area, or "
                "give diameter instead of it",
                section.thickness,
            )


def _add_plugins(given: Any, folder: Path, problems: Problems) -> None:
    """Add the modules of the files ``plugins``; those that are no names are refused with the other keys."""
    for i, name in enumerate(given if isinstance(given, list) else ()):
        if isinstance(name, str) and name and "\0" not in name:
            try:
                add_plugin(folder / name)
            except InputError as error:
                problems.add(("plugins", i), str(error), name)


def _hint(key: str, known: Iterable[str]) -> str:
    """Return a hint about a top-level key that no case has."""
    return f"; {_ARGUMENTS[key]}" if key in _ARGUMENTS else nearest(key, list(known))


def _checked_name(name: Any, source: str) -> str:
    """Return the name of a case, which is the default folder of its results below ``results``."""
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{source}: name = {name!r:.60}: expected a text, the default folder of the results")
    if name.startswith("/") or ".." in name.split("/"):
        raise InputError(f"{source}: name = {name!r:.60}: expected the name of a folder below results")
    return name


class StageTables(NamedTuple):
    """A stage as read: a case of its own, made of the tables in force, so that all checks of a case serve.

    A table that a stage gives replaces that table from this stage on; the others stay in force. ``initial`` and
    ``remove`` are exceptions: velocities are added at the start of the stage that gives them, and at no later one, and
    what a stage removes is gone in later ones, which may not even know the supports. ``section`` has the prestress of
    the sections that a stage stresses; all else of a section is the same in all stages.

    Attributes
    ----------
    name : of the stage
    data : the tables of the case that are in force
    given : the tables that the stage gives itself; stressed : names of the sections whose prestress it gives
    owner : the number of the stage that gave each table that is not the case's own
    of : of a stage that follows from load cases: the key path of its table
    starts_from : the number of the stage that it starts from, if that is not the one before
    """

    name: str
    data: dict[str, Any]
    given: tuple[str, ...]
    stressed: tuple[str, ...]
    owner: Mapping[str, int]
    of: KeyPath | None = None
    starts_from: int | None = None

    @property
    def derived(self) -> bool:
        """Whether it follows from load cases."""
        return self.of is not None

    def place(self, path: KeyPath) -> KeyPath:
        """Return the path in the case of a key of the tables in force: ``stage[1].static.step``."""
        if self.of is not None:
            return (*self.of, *path)
        return ("stage", self.owner[str(path[0])], *path) if path and path[0] in self.owner else path


def stages_of(data: Mapping[str, Any], problems: Problems) -> list[StageTables]:
    """The stages of a case's nested tables; rejected ones are reported in ``problems`` and left out."""
    rows = data["stage"]
    text = "expected a list of at least one table, each under a heading [[stage]]"
    if not isinstance(rows, list) or not rows:
        problems.add(("stage",), text, rows)
        return []
    for key in [key for key in ANALYSES if key in data]:
        having = [f"stage[{k}].{key}" for k, row in enumerate(rows) if isinstance(row, Mapping) and key in row]
        there = f"; this case has {', '.join(having)}" if having else ""
        problems.add((), f"[{key}] and [[stage]] exclude each other: give [stage.{key}]{there}")
    last = len(rows) - 1
    not_common = ("stage", "load_case", "combination", "modes", *ANALYSES)
    common = {key: value for key, value in data.items() if key not in not_common}
    owner: dict[str, int] = {}
    found: list[StageTables] = []
    for k, row in enumerate(rows):
        if not isinstance(row, Mapping):
            problems.add(("stage", k), "expected a table", row)
            continue
        name, taken = row.get("name", f"stage{k + 1}"), [stage.name for stage in found]
        read = problems.validated(StageName, {"name": name}, None, lambda path, k=k: ("stage", k, *path))
        name = read.name if read is not None else f"stage{k + 1}"
        if name in taken:
            problems.add(("stage", k, "name"), "another stage has this name", name)
        known = ["name", *ANALYSES, *STAGE_TABLES]
        for key in [key for key in row if key not in known]:
            problems.add(("stage", k, key), f"unknown key of a stage{nearest(key, known)}")
        given = tuple(key for key in STAGE_TABLES if key in row)
        tables = {key: row[key] for key in given}
        if "output" in tables:
            tables["output"] = _output(tables["output"], common.get("output", {}), k, problems)
        if "section" in tables:
            tables["section"] = _sections(tables["section"], common.get("section"), k, problems)
        for key in ONE_STAGE if k else ():
            common.pop(key, None)
        common |= tables
        owner |= dict.fromkeys((*given, *ANALYSES), k)
        owner.pop("output", None)
        chosen = [key for key in ANALYSES if key in row]
        text = f"expected one of the tables [stage.time], [stage.static]; {'not both' if chosen else 'it has none'}"
        if len(chosen) != 1:
            problems.add(("stage", k), text)
            continue
        here = {**common, chosen[0]: row[chosen[0]]}
        if k == last and "modes" in data:
            here["modes"] = data["modes"]
        stressed = tuple(row["section"]) if isinstance(row.get("section"), Mapping) else ()
        found.append(StageTables(name, here, given, stressed, dict(owner)))
    return found


def _sections(given: Any, common: Any, k: int, problems: Problems) -> Any:
    """The sections of a stage: those of the case, with the prestress that it gives."""
    tables = isinstance(given, Mapping) and isinstance(common, Mapping)
    if not tables:
        problems.add(("stage", k, "section"), "expected tables by the names of sections", given)
        return common
    merged = dict(common)
    for name, table in given.items():
        path = ("stage", k, "section", str(name))
        if not isinstance(common.get(name), Mapping):
            problems.add(path, f"there is no section of this name{nearest(str(name), list(common))}")
        elif not isinstance(table, Mapping) or len(table) != 1 or not set(table) <= set(PRESTRESSES):
            known = ", ".join(PRESTRESSES)
            problems.add(path, f"a stage can only change the prestress of a section: expected one of {known}")
        else:
            kept = {key: value for key, value in common[name].items() if key not in PRESTRESSES}
            merged[name] = {**kept, **table}
    return merged


def _output(given: Any, common: Any, k: int, problems: Problems) -> Any:
    """The output of a stage: its keys over those of the case."""
    read = problems.validated(StageOutput, given, None, lambda path: ("stage", k, "output", *path))
    if read is None or not isinstance(common, Mapping):
        return common
    return {**common, **read.model_dump(exclude_none=True)}


def load_case_stages(
    data: Mapping[str, Any], model: CaseModel, stages: Sequence[StageTables], start: CaseModel, problems: Problems
) -> list[StageTables]:
    """The stages that follow from the load cases and combinations of a case, with one before them if it has none.

    ``start`` is the validated last stage, or the case without stages."""
    made: list[StageTables] = []
    text = "modes are those of one state, and not of load cases: give a case without them"
    if model.modes is not None:
        problems.add(("modes",), text)
        return []
    if not stages:
        text = "[[load_case]] needs [static], by which each of them is solved, or static stages before"
        if model.static is None:
            problems.add((), text)
            return []
        common = {key: value for key, value in data.items() if key not in ("load_case", "combination", "modes")}
        made.append(StageTables(load_cases.PERMANENT, common, (), (), {}, of=()))
    last = [*stages, *made][-1]
    text = f"load cases start from a static state, and the last stage {last.name!r} is none"
    if "static" not in last.data:
        problems.add((), text)
        return []
    static = last.data["static"] if isinstance(last.data["static"], Mapping) else {}
    method = static.get("method", "newton")
    if method == "force_density":  # the net as built
        static, method = {"method": "newton"}, "newton"
    known = ", ".join(load_cases.METHODS)
    text = f"load cases are solved by the method of the state before them, one of {known}; got {method}"
    if method not in load_cases.METHODS:
        problems.add((), text)
        return []
    names = [stage.name for stage in (*stages, *made)]
    keys = [("load_case", k) for k in range(len(model.load_case))]
    keys += [("combination", k) for k in range(len(model.combination))]
    common = {key: value for key, value in last.data.items() if key not in ("modes", *ONE_STAGE)} | {"static": static}
    rows: list[dict[str, Any]] = []
    try:
        for row in load_cases.stage_rows(model.load_case, model.combination, load_cases.at_end(start)):
            rows.append(row)  # one by one: which one cannot be made?
    except load_cases.UnsuitableError as error:
        wrong = [*model.load_case, *model.combination][len(rows)]
        problems.add(keys[len(rows)], f"{wrong.name!r} {error}")
        return []
    base = len(stages) + len(made) - 1
    for of, row in zip(keys, rows, strict=True):
        name = row.pop("name")
        before = not stages and name == load_cases.PERMANENT
        text = "the state before the load cases has this name: give another"
        text = text if before else "another load case, combination or stage has it"
        if name in names:
            problems.add((*of, "name"), text, name)
        names.append(name)
        made.append(StageTables(name, {**common, **row}, tuple(row), (), {}, of=of, starts_from=base))
    return made
