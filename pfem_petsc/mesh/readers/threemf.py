"""3MF files with beam lattices (.3mf): beams are bars, beam sets are bar groups, radii give areas.

Coordinates have the unit of the file and are converted to metres. All objects of the build are read, with their
components and transforms; triangles are left out. A beam whose radii differ has the area of a round bar of the same
volume. Node groups are those that this program writes, as metadata.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from xml.parsers import expat

import numpy as np

from ...errors import InputError
from ..slab import check_memory
from ..whole import WholeMesh
from ._threemf_model import Lattice, ModelFile

__all__ = ["SUFFIXES", "read"]

SUFFIXES = (".3mf",)

_SMALL, _COMPRESSED = 10**7, 200
_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the beam lattices in a 3MF file, with the field ``area``.

    Raises
    ------
    InputError
        Naming the line of the model, if the file is not 3MF, or has no beam lattice.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            name = _model_name(path, archive)
            _check_content(path, archive.getinfo(name))
            model = ModelFile(f"{path}: {name}")
            with archive.open(name) as stream:
                model.parse(stream)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise InputError(f"{path}: is not 3MF, or damaged ({error}): write it again") from None
    return _assembled(path, model)


def _check_content(path: Path, part: zipfile.ZipInfo) -> None:
    """Refuse a part that is mostly blanks or repetitions: text of lattices is compressed to a tenth or a twentieth."""
    if part.file_size > max(_SMALL, _COMPRESSED * part.compress_size):
        raise InputError(
            f"{path}: {part.filename} has {part.file_size:,} bytes in {part.compress_size:,} compressed ones, as no "
            "lattice has: the file is damaged: write it again"
        )


def _model_name(path: Path, archive: zipfile.ZipFile) -> str:
    """Return the name of the model from the relationships of the package."""
    targets: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag.rpartition(":")[2] == "Relationship" and attributes.get("Type") == _MODEL:
            targets.append(attributes.get("Target", "").lstrip("/"))

    names = archive.namelist()
    if "_rels/.rels" in names:
        _check_content(path, archive.getinfo("_rels/.rels"))
        parser = expat.ParserCreate()
        parser.StartElementHandler = start
        try:
            parser.Parse(archive.read("_rels/.rels"), True)
        except (expat.ExpatError, LookupError, ValueError) as error:
            raise InputError(f"{path}: _rels/.rels: {error}") from None
    for name in [*targets, "3D/3dmodel.model"]:
        if name in names:
            return name
    raise InputError(f"{path}: has no model (3D/3dmodel.model): it is not 3MF")


def _assembled(path: Path, model: ModelFile) -> WholeMesh:
    """Return the lattices of all items of the build as one mesh."""
    check_memory(model.check_instances(), str(path))
    placed: list[tuple[str, Lattice, np.ndarray, np.ndarray]] = []
    for number, (name, lattice, place) in enumerate(model.placed()):
        placed.append((name or f"object_{number}", lattice, place, lattice.used()))
    if not placed:
        raise InputError(f"{path}: has no beam lattice; a surface of triangles is read from STL")
    points, bars, areas = [], [], []
    groups: dict[str, list[np.ndarray]] = {}
    node_groups: dict[str, list[np.ndarray]] = {}
    n_nodes = n_bars = 0
    conical = left = 0
    for name, lattice, place, used in placed:
        own = lattice.points[used] * model.scale
        if not np.array_equal(place, np.eye(4, 3)):
            own = own @ place[:3] + place[3] * model.scale
        number = np.cumsum(used) - 1 + n_nodes
        points.append(own)
        bars.append(number[lattice.ends])
        size = abs(np.linalg.det(place[:3])) ** (1.0 / 3.0) * model.scale
        one, two = lattice.radii[:, 0] * size, lattice.radii[:, 1] * size
        areas.append(np.where(one == two, np.pi * one * one, np.pi / 3.0 * (one * one + one * two + two * two)))
        conical += int((one != two).sum())
        left += int((~used).sum())
        for group, members in lattice.sets.items():
            groups.setdefault(group, []).append(members + n_bars)
        if len(placed) > 1:
            groups.setdefault(name, []).append(np.arange(n_bars, n_bars + len(lattice.ends)))
        for group, members in model.node_groups.items():
            inside = members[members < len(used)]
            node_groups.setdefault(group, []).append(number[inside[used[inside]]])
        n_nodes, n_bars = n_nodes + len(own), n_bars + len(lattice.ends)
    mesh = WholeMesh(np.concatenate(points), np.concatenate(bars))
    mesh.bar_groups = {name: np.unique(np.concatenate(parts)) for name, parts in groups.items()}
    mesh.node_groups = {name: np.unique(np.concatenate(parts)) for name, parts in node_groups.items()}
    area = np.concatenate(areas)
    if (area > 0.0).all():
        mesh.bar_fields["area"] = area
    for uri in model.not_read:
        mesh.warnings.append(f"{path}: requires the extension {uri}, which is not read")
    if conical:
        mesh.warnings.append(f"{path}: {conical} beams whose radii differ have a constant area, with the same volume")
    if left or model.triangles:
        mesh.warnings.append(f"{path}: left out {model.triangles} triangles and {left} vertices where no beam ends")
    return mesh
