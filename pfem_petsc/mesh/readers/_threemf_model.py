"""The XML model of a 3MF file: units, objects with beam lattices, components and build items."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, Any
from xml.parsers import expat

import numpy as np

from ...errors import InputError
from ._text import numbers_of

__all__ = ["CORE", "GROUP", "LATTICE", "UNITS", "Lattice", "ModelFile"]

UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
"""Metres in a unit of 3MF."""

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
LATTICE = "http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02"

_KNOWN = "http://schemas.microsoft.com/3dmanufacturing/beamlattice/"

GROUP = "node_group."
"""Beginning of the local names of metadata with a node group: name and numbers from 0, separated by a line break."""

_DEEPEST = 50
_INSTANCES = 10**6


class Lattice:
    """What an object has."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.vertices: list[str] = []
        self.beams: list[tuple[str, str, str, str]] = []
        self.radius = ""
        self.lists: list[tuple[str, list[str]]] = []
        self.components: list[tuple[str, np.ndarray]] = []

    def finish(self, where: str) -> None:
        """Convert texts to arrays: ``points`` (n, 3), ``ends`` (n, 2), ``radii`` (n, 2), ``sets`` by name."""
        self.points = _numbers(self.vertices, f"{where}: a vertex", 3).reshape(-1, 3)
        radius = self.radius or "nan"
        texts = [(a, b, one or radius, two or one or radius) for a, b, one, two in self.beams]
        table = _numbers([" ".join(row) for row in texts], f"{where}: a beam", 4).reshape(-1, 4)
        self.ends, self.radii = _whole(table[:, :2], len(self.points), f"{where}: beams: vertex"), table[:, 2:]
        if not (self.radii >= 0.0).all():
            bad = int(np.flatnonzero(~(self.radii >= 0.0).all(axis=1))[0])
            raise InputError(f"{where}: beam {bad} has no radius (r1, or radius of the beamlattice) that is positive")
        self.sets: dict[str, np.ndarray] = {}
        for name, numbers in self.lists:
            members = _numbers(numbers, f"{where}: beamset {name}")
            self.sets[name.replace("/", "_")] = _whole(members, len(self.ends), f"{where}: beamset {name}: beam")
        self.vertices, self.beams, self.lists = [], [], []

    def used(self) -> np.ndarray:
        """Return which vertices (n,) are ends of beams."""
        used = np.zeros(len(self.points), bool)
        used[self.ends] = True
        return used


class ModelFile:
    """A model part of a 3MF package.

    Attributes
    ----------
    scale : float
        Metres in the unit of the file.
    not_read : list of str
        Namespaces of extensions that the file requires, and that are not read.
    triangles : int
        Number of triangles.
    node_groups : dict
        Numbers of vertices of groups that this program has written, by name.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._objects: dict[str, Lattice] = {}
        self._counts: dict[str, tuple[int, int]] = {}
        self._items: list[tuple[str, np.ndarray]] = []
        self._current = Lattice("")
        self._text: list[str] | None = None
        self._texts: list[str] = []
        self._namespaces: dict[str, str] = {}
        self.not_read: list[str] = []
        self.scale = 1e-3
        self.triangles = 0
        self.node_groups: dict[str, np.ndarray] = {}

    def parse(self, stream: IO[bytes]) -> None:
        """Read the XML.

        Raises
        ------
        InputError
            Naming the line, for any content that is not a model.
        """
        parser = expat.ParserCreate(namespace_separator=" ")
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._characters
        parser.StartNamespaceDeclHandler = self._declared
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._line = lambda: parser.CurrentLineNumber
        try:
            parser.ParseFile(stream)
        except KeyError as error:
            raise InputError(f"{self._where}: line {self._line()}: the attribute {error} is missing") from None
        except (expat.ExpatError, LookupError, ValueError) as error:  # the last two for unknown encodings
            raise InputError(f"{self._where}: {error}: the file is damaged: write it again") from None
        for number, lattice in self._objects.items():
            lattice.finish(f"{self._where}: object {number}")
        for text in self._texts:
            name, _, numbers = text.partition("\n")
            members = _numbers(numbers.split(), f"{self._where}: node group {name}")
            self.node_groups[name] = _whole(members, 2**53, f"{self._where}: node group {name}: node")

    def _refuse_doctype(self, *_: Any) -> None:
        raise InputError(f"{self._where}: line {self._line()}: a document type, which 3MF does not allow")

    def _declared(self, prefix: str | None, uri: str) -> None:
        self._namespaces[prefix or ""] = uri

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        name = tag.rpartition(" ")[2]
        if name == "vertex":
            x, y, z = attributes["x"], attributes["y"], attributes["z"]
            self._current.vertices.append(f"{x} {y} {z}")
        elif name == "beam":
            get = attributes.get
            self._current.beams.append((attributes["v1"], attributes["v2"], get("r1", ""), get("r2", "")))
        elif name == "triangle":
            self.triangles += 1
        elif name == "ref" and self._current.lists:
            self._current.lists[-1][1].append(attributes["index"])
        else:
            handle = getattr(self, f"_start_{name}", None)
            if handle is not None:
                handle(attributes)

    def _end(self, tag: str) -> None:
        if self._text is not None:
            self._texts.append("".join(self._text))
            self._text = None

    def _characters(self, text: str) -> None:
        if self._text is not None:
            self._text.append(text)

    def _start_model(self, attributes: dict[str, str]) -> None:
        unit = attributes.get("unit", "millimeter")
        if unit not in UNITS:
            raise InputError(f"{self._where}: line {self._line()}: unit {unit!r}; known: {', '.join(UNITS)}")
        self.scale = UNITS[unit]
        for prefix in attributes.get("requiredextensions", "").split():
            uri = self._namespaces.get(prefix, prefix)
            if not uri.startswith(_KNOWN):
                self.not_read.append(uri)

    def _start_metadata(self, attributes: dict[str, str]) -> None:
        if attributes.get("name", "").partition(":")[2].startswith(GROUP):
            self._text = []

    def _start_object(self, attributes: dict[str, str]) -> None:
        self._current = self._objects[attributes["id"]] = Lattice(attributes.get("name", ""))

    def _start_beamlattice(self, attributes: dict[str, str]) -> None:
        self._current.radius = attributes.get("radius", "")

    def _start_beamset(self, attributes: dict[str, str]) -> None:
        number = len(self._current.lists)
        name = attributes.get("name") or attributes.get("identifier") or f"beamset_{number}"
        self._current.lists.append((name, []))

    def _start_component(self, attributes: dict[str, str]) -> None:
        self._current.components.append((self._named(attributes), self._transform(attributes)))

    def _start_item(self, attributes: dict[str, str]) -> None:
        self._items.append((self._named(attributes), self._transform(attributes)))

    def _named(self, attributes: dict[str, str]) -> str:
        if any(key.rpartition(" ")[2] == "path" for key in attributes):
            raise InputError(
                f"{self._where}: line {self._line()}: an object in another part of the file (production extension), "
                "which is not read: export without it"
            )
        return attributes["objectid"]

    def _transform(self, attributes: dict[str, str]) -> np.ndarray:
        """Return a transform (4, 3): applied to rows [x, y, z, 1] from the right."""
        text = attributes.get("transform")
        if text is None:
            return np.eye(4, 3)
        values = _numbers([text], f"{self._where}: line {self._line()}: transform", 12)
        return values.reshape(4, 3)

    def check_instances(self) -> int:
        """Return the number of vertices of all objects of the build where beams end, after their number was checked.

        Raises
        ------
        InputError
            If a component or item has no object, or has itself as a component; or if there are too many of them.
        """
        instances, nodes = np.sum(
            [self._count(number, 0) for number, _ in self._items] or [(0, 0)], axis=0, dtype=object
        )
        if instances > _INSTANCES:
            raise InputError(
                f"{self._where}: the build places {instances:,} objects and components, and at most {_INSTANCES:,} are "
                "read: write the lattice as fewer, larger objects"
            )
        return int(nodes)

    def _count(self, number: str, depth: int) -> tuple[int, int]:
        """Return how many objects and components an object consists of, and their number of vertices with beams."""
        if number not in self._objects:
            raise InputError(f"{self._where}: there is no object {number}, which the build or a component names")
        if depth > _DEEPEST:
            raise InputError(f"{self._where}: object {number} is a component of itself")
        if number not in self._counts:
            lattice = self._objects[number]
            parts = [self._count(other, depth + 1) for other, _ in lattice.components]
            own = int(lattice.used().sum()) if len(lattice.ends) else 0
            self._counts[number] = 1 + sum(part[0] for part in parts), own + sum(part[1] for part in parts)
        return self._counts[number]

    def placed(self) -> Iterator[tuple[str, Lattice, np.ndarray]]:
        """Return name, content and transform (4, 3) of each object of the build that has beams."""
        for number, place in self._items:
            yield from self._within(number, place)

    def _within(self, number: str, place: np.ndarray) -> Iterator[tuple[str, Lattice, np.ndarray]]:
        lattice = self._objects[number]
        if len(lattice.ends):
            yield lattice.name, lattice, place
        for other, inner in lattice.components:
            move = inner[3] @ place[:3] + place[3]
            yield from self._within(other, np.vstack([inner[:3] @ place[:3], move]))


def _numbers(texts: list[str], what: str, width: int = 0) -> np.ndarray:
    """Return the numbers of texts, each with ``width`` of them; 0: any number."""
    try:
        values = numbers_of(" ".join(texts).encode())
    except ValueError:
        values = np.empty(0)
        width = width or -1
    if (width and len(values) != width * len(texts)) or width < 0:
        wrong = next((text for text in texts if not _are_numbers(text, width)), "")
        raise InputError(f"{what}: {wrong[:60]!r} are not {'' if width < 0 else f'{width} '}numbers")
    return values


def _are_numbers(text: str, width: int) -> bool:
    try:
        found = len([float(word) for word in text.split()])
    except ValueError:
        return False
    return found > 0 if width < 0 else found == width


def _whole(values: np.ndarray, n: int, what: str) -> np.ndarray:
    wrong = values[~((values >= 0.0) & (values < n) & (values == np.rint(values)))]
    if wrong.size:
        raise InputError(f"{what} {wrong.flat[0]:g} is not there; they are numbered from 0 to {n - 1}")
    return values.astype(np.int64)
