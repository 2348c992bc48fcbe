"""3MF files with a beam lattice (.3mf), in metres: radii are those of round bars, bar groups are beam sets.

Node groups are metadata that other programs pass over.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from ...errors import InputError
from ..readers._threemf_model import CORE, GROUP, LATTICE
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".3mf",)

_OWN = "urn:pfem_petsc"
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
            for text in _model(mesh, np.sqrt(area / np.pi)):
                file.write(text.encode())


def _model(mesh: WholeMesh, radius: np.ndarray) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>\n<model unit="meter" xml:lang="en-US"'
    yield f' xmlns="{CORE}" xmlns:b="{LATTICE}" xmlns:own="{_OWN}" requiredextensions="b">\n'
    for number, (name, members) in enumerate(mesh.node_groups.items()):
        numbers = " ".join(map(str, members.tolist()))
        yield f'<metadata name="own:{GROUP}{number}" type="xs:string">{escape(name)}\n{numbers}</metadata>\n'
    yield '<resources><object id="1" type="model" name="truss"><mesh>\n<vertices>\n'
    yield "".join(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>\n' for x, y, z in mesh.points.tolist())
    length = np.linalg.norm(mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]], axis=1)
    shortest = _SHORT * float(length.min(initial=1.0))
    yield f'</vertices>\n<triangles/>\n<b:beamlattice radius="{float(radius[0])!r}" minlength="{shortest!r}"'
    yield ' cap="sphere">\n<b:beams>\n'
    if (radius == radius[0]).all():
        yield "".join(f'<b:beam v1="{a}" v2="{b}"/>\n' for a, b in mesh.bars.tolist())
    else:
        rows = zip(mesh.bars.tolist(), radius.tolist(), strict=True)
        yield "".join(f'<b:beam v1="{a}" v2="{b}" r1="{r!r}" r2="{r!r}"/>\n' for (a, b), r in rows)
    yield "</b:beams>\n"
    if mesh.bar_groups:
        yield "<b:beamsets>\n"
        for number, (name, members) in enumerate(mesh.bar_groups.items()):
            yield f'<b:beamset name={quoteattr(name)} identifier="set{number}">\n'
            yield "".join(f'<b:ref index="{i}"/>\n' for i in members.tolist()) + "</b:beamset>\n"
        yield "</b:beamsets>\n"
    yield '</b:beamlattice></mesh></object></resources>\n<build><item objectid="1"/></build>\n</model>\n'
