"""STL and 3MF files of other programs, whole and with one thing wrong."""

import zipfile

import numpy as np
import pytest

from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole

STL = """solid tetra
 facet normal 0 0 0
  outer loop
   vertex 0 0 0
   vertex 1.0E+00 0 0
   VERTEX 0 1 -0.0
  endloop
 endfacet
 facet normal 0 0 0
  outer loop
   vertex 0 0 0
   vertex 0 1 0
   vertex 0 0 1
  endloop
 endfacet
endsolid tetra
"""


def test_stl_edges(tmp_path):
    (tmp_path / "t.stl").write_text(STL)
    mesh = read_whole(tmp_path / "t.stl")
    lengths = np.sort(np.linalg.norm(mesh.points[mesh.bars[:, 0]] - mesh.points[mesh.bars[:, 1]], axis=1))
    assert len(mesh.points) == 4
    np.testing.assert_allclose(lengths, [1.0, 1.0, 1.0, 2**0.5, 2**0.5])
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 0, 0]] * 3], "<f4")
    facets = b"".join(bytes(12) + facet.tobytes() + bytes(2) for facet in corners)
    (tmp_path / "b.stl").write_bytes(b"solid of another program".ljust(80) + b"\3\0\0\0" + facets)
    binary = read_whole(tmp_path / "b.stl")
    np.testing.assert_array_equal(binary.points, mesh.points)
    np.testing.assert_array_equal(binary.bars, mesh.bars)
    assert binary.warnings == [f"{tmp_path}/b.stl: has no lines: the 5 edges of its 2 faces are bars"]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (STL.replace("vertex 0 0 1", "vertex 0 0"), "vertex: 'endloop' is not a number"),
        (STL.replace("vertex 0 0 1", "vertex 0 0 one"), "vertex: 'one' is not a number"),
        (STL.replace("vertex 0 0 1\n", "\n"), "has 5 vertices, 2 times endfacet and an endsolid; expected three"),
        ("x" * 83, "is not STL"),
        (b"x" * 80 + b"\2\0\0\0" + bytes(50), "the triangles that it declares take 184 bytes, and it has 134"),
        (b"x" * 80 + bytes(4), "has neither lines nor faces"),
    ],
)
def test_stl_with_one_thing_wrong(tmp_path, content, text):
    path = tmp_path / "w.stl"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=text) as caught:
        read_whole(path)
    assert str(path) in str(caught.value)


MODEL = """<?xml version="1.0" encoding="utf-8"?>
<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
 xmlns:bl="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02" requiredextensions="bl">
 <metadata name="Title">made elsewhere</metadata>
 <resources>
  <object id="4" type="model"><mesh><vertices>
    <vertex x="0" y="0" z="0"/><vertex x="10" y="0" z="0"/><vertex x="0" y="10" z="0"/><vertex x="9" y="9" z="9"/>
   </vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles>
   <bl:beamlattice radius="1" minlength="0.001" cap="hemisphere"><bl:beams>
    <bl:beam v1="0" v2="1"/><bl:beam v1="1" v2="2" r1="0.5"/><bl:beam v1="2" v2="0" r1="1" r2="2" cap1="butt"/>
   </bl:beams><bl:beamsets><bl:beamset name="thin" identifier="a"><bl:ref index="1"/></bl:beamset></bl:beamsets>
   </bl:beamlattice></mesh></object>
  <object id="5" type="model" name="pair"><components>
    <component objectid="4"/><component objectid="4" transform="0 1 0 -1 0 0 0 0 1 100 0 0"/></components></object>
 </resources>
 <build><item objectid="5" transform="2 0 0 0 2 0 0 0 2 0 0 5"/></build>
</model>"""


def three_mf(path, model=MODEL, name="3D/part.model"):
    """A package whose relationships name the model."""
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "_rels/.rels", f'<Relationships><Relationship Target="/{name}" Id="r" Type="{kind}"/></Relationships>'
        )
        archive.writestr(name, model)
    return path


def test_3mf_of_another_program(tmp_path):
    """Millimetres, radii of the lattice and of beams, components and transforms."""
    required = MODEL.replace('requiredextensions="bl"', 'xmlns:v="urn:volumes" requiredextensions="bl v"')
    *_, told = [w for w in read_whole(three_mf(tmp_path / "p.3mf", required)).warnings if "extension" in w]
    assert told.endswith("requires the extension urn:volumes, which is not read")
    mesh = read_whole(three_mf(tmp_path / "p.3mf"))
    expected = np.array([[0, 0, 5], [20, 0, 5], [0, 20, 5], [200, 0, 5], [200, 20, 5], [180, 0, 5]]) * 1e-3
    np.testing.assert_allclose(mesh.points, expected, atol=1e-16)
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [2, 0], [3, 4], [4, 5], [5, 3]]
    # cones between radii of 2 and 4 mm: the mean square of the radius is 28/3 mm2
    np.testing.assert_allclose(mesh.bar_fields["area"], np.pi * 1e-6 * np.array([4, 1, 28 / 3] * 2), rtol=1e-12)
    assert mesh.bar_groups["thin"].tolist() == [1, 4]
    cones, triangles, points = mesh.warnings
    assert "2 beams whose radii differ" in cones and "left out 1 triangles" in triangles
    assert "left out 2 points where no bar ends" in points


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('unit="millimeter"', 'unit="yard"', r"unit 'yard'; known: micron"),
        ('v1="1" v2="2"', 'v2="2"', r"object 4: beam 1 lacks the vertex at one of its ends"),
        ('v1="1" v2="2"', 'v1="1" v2="8"', r"object 4: beams: vertex 8 is not there; they are numbered from 0 to 3"),
        ('x="10"', 'x="ten"', r"object 4: a vertex: could not convert string to float: 'ten'; expected 3 numbers"),
        ('v1="1" v2="2"', 'v1="" v2="2"', r"object 4: a beam: could not convert string to float: ''"),
        ('r1="0.5"', 'r1="-1"', r"object 4: beam 1 has no radius .* that is positive"),
        ('<bl:ref index="1"/>', '<bl:ref index="3"/>', r"beamset thin: beam 3 is not there"),
        ('objectid="5"', 'objectid="9"', r"there is no object 9"),
        ('<component objectid="4"/>', '<component objectid="5"/>', r"object 5 is a component of itself"),
        ("2 0 0 0 2 0 0 0 2 0 0 5", "2 0 0", r"transform of object 5: has 3; expected 12 numbers"),
        ('encoding="utf-8"', 'encoding="x"', r"unknown encoding"),
        ("</resources>", "", r"mismatched tag: line 17"),
        ('objectid="5" t', 'objectid="5" p:path="/3D/o.model" xmlns:p="u" t', r"in another part of the file"),
    ],
)
def test_3mf_with_one_thing_wrong(tmp_path, old, new, text):
    assert old in MODEL
    path = three_mf(tmp_path / "w.3mf", MODEL.replace(old, new, 1))
    with pytest.raises(InputError, match=text) as caught:
        read_whole(path)
    assert str(path) in str(caught.value)


def test_3mf_without_lattice_and_damaged(tmp_path):
    path = three_mf(tmp_path / "s.3mf", MODEL.partition("<bl:beamlattice")[0] + "</mesh></object></resources>"
                    '<build><item objectid="4"/></build></model>')  # fmt: skip
    with pytest.raises(InputError, match="has no beam lattice; a surface of triangles is read from STL"):
        read_whole(path)
    content = three_mf(tmp_path / "d.3mf").read_bytes()
    for damaged in (content[:200], b"", b"PK" + bytes(100)):
        (tmp_path / "d.3mf").write_bytes(damaged)
        with pytest.raises(InputError, match="d.3mf: is not 3MF, or damaged"):
            read_whole(tmp_path / "d.3mf")
