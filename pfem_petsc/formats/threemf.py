"""3MF files with beam lattices (.3mf): beams are bars, beam sets are bar groups, radii give areas.

Coordinates have the unit of the file and are converted to metres; written files are in metres. All objects of the build
are read, with their components and transforms; triangles are left out. A beam whose radii differ has the area of a
round bar of the same volume. Node groups are those that this program writes, as metadata that others pass over.
"""

from __future__ import annotations

import zipfile
import zlib
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from ..errors import InputError
from ..mesh.slab import check_memory
from ..mesh.whole import WholeMesh
from ._common import drop_bare_nodes, whole_numbers

SUFFIXES = (".3mf",)

_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_LATTICES = "http://schemas.microsoft.com/3dmanufacturing/beamlattice/"
_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_GROUP = "node_group."
"""Beginning of the local names of metadata with a node group: name and numbers from 0, separated by a line break."""

# text of lattices is compressed to a tenth or a twentieth
_SMALL, _COMPRESSED = 10**7, 200
_DEEPEST = 50
_INSTANCES = 10**6


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the beam lattices in a 3MF file, with the field ``area``.

    Raises
    ------
    InputError
        Naming the object, if the file is not 3MF, or has no beam lattice.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            name = _model_name(path, archive)
            with _part(path, archive, name) as stream:
                model = _Model(f"{path}: {name}", stream)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise InputError(f"{path}: is not 3MF, or damaged ({error}): write it again") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two for unknown encodings
        raise InputError(f"{path}: {error}: the file is damaged: write it again") from None
    return _assembled(path, model)


def _model_name(path: Path, archive: zipfile.ZipFile) -> str:
    """Return the name of the model from the relationships of the package."""
    names, found = archive.namelist(), []
    if "_rels/.rels" in names:
        with _part(path, archive, "_rels/.rels") as stream:
            parts = ElementTree.parse(stream).iter()
            found = [part.get("Target", "").lstrip("/") for part in parts if part.get("Type") == _MODEL]
    for name in (*found, "3D/3dmodel.model"):
        if name in names:
            return name
    raise InputError(f"{path}: has no model (3D/3dmodel.model): it is not 3MF")


def _part(path: Path, archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """Open a part of the package, in which no part is mostly blanks."""
    part = archive.getinfo(name)
    if part.file_size > max(_SMALL, _COMPRESSED * part.compress_size):
        raise InputError(
            f"{path}: {name} has {part.file_size:,} bytes in {part.compress_size:,} compressed ones, as no lattice "
            "has: the file is damaged: write it again"
        )
    return archive.open(name)


Placed = tuple[str, np.ndarray]
"""An object of a component or item, and its transform (4, 3), applied to rows [x, y, z, 1] from the right."""

_ATTRIBUTES = {"vertex": ("x", "y", "z"), "beam": ("v1", "v2", "r1", "r2"), "ref": ("index",)}


class _Object:
    """An object: ``points`` (n, 3), ``ends`` (m, 2) and ``radii`` (m, 2) of beams, ``sets`` of beams by name,
    and ``components``.

    Parameters
    ----------
    texts : by tags, the attributes of the elements in it
    """

    def __init__(self, where: str, name: str, texts: dict[str, list[Any]]) -> None:
        self.name, self.components = name, texts["component"]
        self.points = _numbers(texts["vertex"], f"{where}: a vertex", 3)
        table = _numbers(texts["beam"], f"{where}: a beam", 4)
        for k in np.flatnonzero(np.isnan(table[:, :2]).any(axis=1))[:1].tolist():
            raise InputError(f"{where}: beam {k} lacks the vertex at one of its ends (v1, v2)")
        self.ends, self.radii = _whole(table[:, :2], len(self.points), f"{where}: beams: vertex"), table[:, 2:]
        default = _numbers(texts["beamlattice"] or [None], f"{where}: radius").ravel()
        for radius in self.radii.T:  # the second radius of a beam is the first one where it is not given
            radius[:] = default = np.where(np.isnan(radius), default, radius)
        for k in np.flatnonzero(~(self.radii >= 0.0).all(axis=1))[:1].tolist():
            raise InputError(f"{where}: beam {k} has no radius (r1, or radius of the beamlattice) that is positive")
        self.sets = {}
        for group, numbers in texts["beamset"]:
            members = _numbers(numbers, f"{where}: beamset {group}").ravel()
            self.sets[group.replace("/", "_")] = _whole(members, len(self.ends), f"{where}: beamset {group}: beam")


class _Model:
    """The model of a package: objects, what is built of them, and metres in the unit of the file.

    ``not_read`` are the namespaces of required extensions that are not read, ``node_groups`` the numbers of vertices.
    """

    def __init__(self, where: str, stream: IO[bytes]) -> None:
        self.where, self.scale, self.triangles = where, 1e-3, 0
        self.objects: dict[str, _Object] = {}
        self.items: list[Placed] = []
        self.not_read: list[str] = []
        self.node_groups: dict[str, np.ndarray] = {}
        self._sizes: dict[str, np.ndarray] = {}
        texts, namespaces = defaultdict(list), {}
        for event, element in ElementTree.iterparse(stream, ("start-ns", "end")):
            if event == "start-ns":
                namespaces[element[0]] = element[1]
                continue
            get, tag = element.get, element.tag.rpartition("}")[2]
            match tag:
                case "vertex" | "beam" | "ref":
                    texts[tag].append(tuple(map(get, _ATTRIBUTES[tag])))
                case "triangle":
                    self.triangles += 1
                case "beamset":
                    name = get("name") or get("identifier") or f"beamset_{len(texts[tag])}"
                    texts[tag].append((name, texts.pop("ref", [])))
                case "beamlattice":
                    texts[tag] = [get("radius")]
                case "component":
                    texts[tag].append(self._placed(element))
                case "object":
                    number = get("id", "")
                    self.objects[number] = _Object(f"{where}: object {number}", get("name", ""), texts)
                    texts = defaultdict(list)
                case "item":
                    self.items.append(self._placed(element))
                case "metadata" if get("name", "").partition(":")[2].startswith(_GROUP):
                    name, _, numbers = (element.text or "").partition("\n")
                    found = _numbers(numbers.split(), f"{where}: node group {name}").ravel()
                    self.node_groups[name] = _whole(found, 2**53, f"{where}: node group {name}: node")
                case "model":
                    unit = get("unit", "millimeter")
                    if unit not in _UNITS:
                        raise InputError(f"{where}: unit {unit!r}; known: {', '.join(_UNITS)}")
                    self.scale = _UNITS[unit]
                    required = [namespaces.get(prefix, prefix) for prefix in get("requiredextensions", "").split()]
                    self.not_read = [uri for uri in required if not uri.startswith(_LATTICES)]
            element.clear()  # large lattices take memory enough as numbers

    def _placed(self, element: ElementTree.Element) -> Placed:
        number = element.get("objectid", "")
        if any(key.rpartition("}")[2] == "path" for key in element.attrib):
            raise InputError(
                f"{self.where}: object {number} is in another part of the file (production extension), which is not "
                "read: export without it"
            )
        numbers = element.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        return number, _numbers([tuple(numbers)], f"{self.where}: transform of object {number}", 12).reshape(4, 3)

    def sizes(self, number: str, depth: int = 0) -> np.ndarray:
        """Return how many objects and components an object consists of, and the number of vertices of those with beams.

        Raises
        ------
        InputError
            If a component or item has no object, or has itself as a component.
        """
        if number not in self.objects:
            raise InputError(f"{self.where}: there is no object {number}, which the build or a component names")
        if depth > _DEEPEST:
            raise InputError(f"{self.where}: object {number} is a component of itself")
        if number not in self._sizes:
            found = self.objects[number]
            own = np.array([1, len(found.points) * bool(len(found.ends))], object)
            self._sizes[number] = own + sum(self.sizes(other, depth + 1) for other, _ in found.components)
        return self._sizes[number]

    def placed(self, number: str, place: np.ndarray) -> Iterator[tuple[_Object, np.ndarray]]:
        """Yield content and transform (4, 3) of an object and its components, those that have beams."""
        found = self.objects[number]
        if len(found.ends):
            yield found, place
        for other, inner in found.components:
            yield from self.placed(other, np.vstack([inner[:3] @ place[:3], inner[3] @ place[:3] + place[3]]))


def _numbers(rows: Sequence[str | tuple[str | None, ...] | None], what: str, width: int = 1) -> np.ndarray:
    """Return texts as numbers (n, width): NaN for those that are missing."""
    try:
        found = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{what}: {error}; expected {width} number{'s' * (width > 1)}") from None
    if found.ndim == 2 and found.shape[1] != width:
        raise InputError(f"{what}: has {found.shape[1]}; expected {width} numbers")
    return found.reshape(-1, width)


def _whole(values: np.ndarray, n: int, what: str) -> np.ndarray:
    return whole_numbers(values, 0, n, f"{what} ", f" is not there; they are numbered from 0 to {n - 1}")


def _assembled(path: Path, model: _Model) -> WholeMesh:
    """Return the lattices of all items of the build as one mesh."""
    instances, nodes = sum((model.sizes(number) for number, _ in model.items), np.array([0, 0], object))
    if instances > _INSTANCES:
        raise InputError(
            f"{model.where}: the build places {instances:,} objects and components, and at most {_INSTANCES:,} are "
            "read: write the lattice as fewer, larger objects"
        )
    check_memory(nodes, str(path))
    placed = [each for item in model.items for each in model.placed(*item)]
    if not placed:
        raise InputError(f"{path}: has no beam lattice; a surface of triangles is read from STL")
    points, bars, radii = [], [], []
    node_groups, bar_groups = defaultdict(list), defaultdict(list)
    n_nodes = n_bars = 0
    for k, (found, place) in enumerate(placed):
        own = found.points * model.scale
        if not np.array_equal(place, np.eye(4, 3)):
            own = own @ place[:3] + place[3] * model.scale
        points.append(own)
        bars.append(found.ends + n_nodes)
        radii.append(found.radii * (abs(np.linalg.det(place[:3])) ** (1.0 / 3.0) * model.scale))
        whole = [(found.name or f"object_{k}", np.arange(len(found.ends)))] if len(placed) > 1 else []
        for group, members in (*found.sets.items(), *whole):
            bar_groups[group].append(members + n_bars)
        for group, members in model.node_groups.items():
            node_groups[group].append(members[members < len(own)] + n_nodes)
        n_nodes, n_bars = n_nodes + len(own), n_bars + len(found.ends)
    groups = [{name: np.unique(np.concatenate(parts)) for name, parts in every.items()}
              for every in (node_groups, bar_groups)]  # fmt: skip
    mesh = WholeMesh(np.concatenate(points), np.concatenate(bars), *groups)
    one, two = np.concatenate(radii).T
    area = np.where(one == two, np.pi * one * one, np.pi / 3.0 * (one * one + one * two + two * two))
    mesh.bar_fields |= {"area": area} if (area > 0.0).all() else {}
    cones = int((one != two).sum())
    mesh.warnings = [f"{path}: requires the extension {uri}, which is not read" for uri in model.not_read]
    mesh.tell(cones, f"{path}: {cones} beams whose radii differ have a constant area, with the same volume")
    mesh.tell(model.triangles, f"{path}: left out {model.triangles} triangles")
    drop_bare_nodes(path, mesh)
    return mesh


_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>\n'
)
_SHORT = 1e-3
"""Of the shortest bar: beams shorter than this may be left out by the programs that read the file."""


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh; coordinates to the last digit.

    Raises
    ------
    InputError
        If the bars have no areas.
    """
    area = mesh.bar_fields.get("area")
    if area is None or not (area > 0.0).all():
        raise InputError(
            f"{path.name}: 3MF needs a radius of each bar, and the mesh has no field area with positive areas [m2]: "
            "give one to all bars (--area of the verb mesh)"
        )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", _TYPES)
        archive.writestr("_rels/.rels", _RELATIONS)
        with archive.open("3D/3dmodel.model", "w", force_zip64=True) as file:
            for text in _model_text(mesh, np.sqrt(area / np.pi)):
                file.write(text.encode())


def _model_text(mesh: WholeMesh, radius: np.ndarray) -> Iterator[str]:
    names = f'xmlns="{_CORE}" xmlns:b="{_LATTICES}2017/02" xmlns:own="urn:pfem_petsc" requiredextensions="b"'
    yield f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="meter" xml:lang="en-US" {names}>\n'
    for number, (name, members) in enumerate(mesh.node_groups.items()):
        numbers = " ".join(map(str, members.tolist()))
        yield f'<metadata name="own:{_GROUP}{number}" type="xs:string">{escape(name)}\n{numbers}</metadata>\n'
    yield '<resources><object id="1" type="model" name="truss"><mesh>\n<vertices>\n'
    yield "".join(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>\n' for x, y, z in mesh.points.tolist())
    length = np.linalg.norm(mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]], axis=1)
    shortest = _SHORT * float(length.min(initial=1.0))
    yield f'</vertices>\n<triangles/>\n<b:beamlattice radius="{float(radius[0])!r}" minlength="{shortest!r}"'
    yield ' cap="sphere">\n<b:beams>\n'
    same = (radius == radius[0]).all()
    radii = repeat("") if same else (f' r1="{r!r}" r2="{r!r}"' for r in radius.tolist())
    yield "".join(f'<b:beam v1="{a}" v2="{b}"{r}/>\n' for (a, b), r in zip(mesh.bars.tolist(), radii)) + "</b:beams>\n"
    sets = [
        f'<b:beamset name={quoteattr(name)} identifier="set{number}">\n'
        + "".join(f'<b:ref index="{i}"/>\n' for i in members.tolist())
        + "</b:beamset>\n"
        for number, (name, members) in enumerate(mesh.bar_groups.items())
    ]
    yield from ("<b:beamsets>\n", *sets, "</b:beamsets>\n") if sets else ()
    yield '</b:beamlattice></mesh></object></resources>\n<build><item objectid="1"/></build>\n</model>\n'
