"""Lines, polylines and faces of drawings and surfaces: OBJ, PLY, VTK, and data structures of COMPAS."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers.files import written
from helpers.pages import DOCS, blocks

from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab, read_whole

OBJ = """# two layers
o tower
v 0 0 0
v 1.123456789012345 0 0
v 0 1 0 1 0 0
g legs outer
l 1/1 2/2 \\
  3/3
vt 0 0
g top
v 0 0 1
l -1 1
f 1 2 3
"""
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\ng one\nf 1//1 2//1 3//1\ng two\nf 1 3 4\n"
RHINO = "v 0 0 0\nv 2 0 0\ncstype bspline\ndeg 1\ncurv 0 2 1 2\nparm u 0 0 2 2\nend\ndeg 3\ncurv 0 1 1 2 1 2\nend\n"
RHINO += "v 0 0 0\nv 0 1 0\nv 0 1 5\ndeg 1\ncurv 0 6 -3 -2 -1\nend\n"


AT_7 = '{"7": {"x": 1, "y": 2, "z": 3}}'
VTK = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 3 double\n0 0 0 1 0 0 0 1 0\n"
HEADER = "ply\nformat ascii 1.0\n"
EDGE_OF_PLY = f"{HEADER}element vertex 2\nproperty float x\nproperty float y\nproperty float z\nelement edge 1\n"
EDGE_OF_PLY += "property int vertex1\nproperty int vertex2\nend_header\n"


def read(folder, content, name):
    mesh = read_whole(written(folder, content, name))
    mesh.warnings = [text.partition(f"{name}: ")[2] for text in mesh.warnings]
    return mesh


def members(groups):
    return {name: own.tolist() for name, own in groups.items()}


def test_lines_of_obj(tmp_path):
    mesh = read(tmp_path, OBJ, "a.obj")
    assert mesh.points.tolist() == [[0, 0, 0], [1.123456789012345, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [3, 0]]
    assert members(mesh.bar_groups) == {"tower": [0, 1, 2], "legs": [0, 1], "outer": [0, 1], "top": [2]}
    assert mesh.warnings == ["the lines are bars: left out 1 faces"]


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.json"])
def test_a_byte_order_mark_is_skipped(tmp_path, name):
    nodes = '{"node": {"0": {"x": 1, "y": 2, "z": 3}, "1": {"x": 4, "y": 5, "z": 6}}, "edge": {"0": {"1": {}}}}'
    text = {"a.obj": "v 1 2 3\nv 4 5 6\nl 1 2\n", "a.ply": f"{EDGE_OF_PLY}1 2 3\n4 5 6\n0 1\n", "a.json": nodes}[name]
    mesh = read(tmp_path, f"\ufeff{text}", name)
    assert mesh.points.tolist() == [[1, 2, 3], [4, 5, 6]] and mesh.bars.tolist() == [[0, 1]] and not mesh.warnings


def test_what_has_no_bar_or_number_is_told(tmp_path):
    mesh = read(tmp_path, "v 0 0 0\nv 1 0 0\nl 1 2\nl 1\n", "a.obj")
    assert mesh.bars.tolist() == [[0, 1]] and mesh.warnings == ["left out 1 l of one point: not read"]
    mesh = read(tmp_path, f"{EDGE_OF_PLY}0 0 0\n1 0 0\n0 1\n7 8 9\n", "a.ply")
    assert mesh.warnings == ["left out 3 numbers after the last element: not read"]
    nodes = {str(i): {"x": i, "y": 0, "z": 0} for i in range(3)}
    content = {"node": nodes, "edge": {"0": {"1": {"q": float("nan")}}, "1": {"2": {"q": 10**400}}}}
    mesh = read(tmp_path, json.dumps(content), "a.json")
    assert mesh.warnings == ["the attribute q is not a finite number 2 times"]


def test_links_and_bytes_that_are_no_text(tmp_path):
    (tmp_path / "a.obj").symlink_to("b.obj")
    with pytest.raises(InputError, match="there is no file .*a.obj: it is a link to b.obj, which is not there"):
        read_whole(tmp_path / "a.obj")
    (tmp_path / "a.vtk").write_bytes(bytes(range(128, 256)) * 9)
    with pytest.raises(InputError, match="a.vtk: cannot be read: Unrecognized file type"):
        read_whole(tmp_path / "a.vtk")


@pytest.mark.parametrize("number", ["nan", "inf", "-1e200"])
def test_no_verb_takes_coordinates_that_are_not_finite(tmp_path, capsys, number):
    file = written(tmp_path, f"v 0 0 0\nv 1 {number} 0\nl 1 2\n", "a.obj")
    for verb in (["info", str(file)], ["convert", str(file), str(tmp_path / "a.vtu")]):
        assert main(["mesh", *verb]) == 2
        assert "1 nodes have coordinates that are not numbers below" in capsys.readouterr().err
    assert not (tmp_path / "a.vtu").exists()
    good = written(tmp_path, "v 0 0 0\nv 1 0 0\nl 1 2\n", "b.obj")
    assert main(["mesh", "convert", str(good), str(tmp_path / "b.vtu"), "--scale", "1e300"]) == 2


def test_faces_of_obj(tmp_path):
    mesh = read(tmp_path, SQUARE, "a.obj")
    assert sorted(map(tuple, mesh.bars.tolist())) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]
    groups = {name: {tuple(mesh.bars[i].tolist()) for i in own} for name, own in mesh.bar_groups.items()}
    assert groups == {"one": {(0, 1), (1, 2), (0, 2)}, "two": {(0, 2), (2, 3), (0, 3)}}
    assert mesh.warnings == ["has no lines: the 5 edges of its 2 faces are bars", "left out 1 points where no bar ends"]


def test_curves_of_degree_1_in_obj_are_polylines(tmp_path):
    mesh = read(tmp_path, RHINO, "a.obj")
    assert mesh.bars.tolist() == [[0, 1], [2, 3], [3, 4]]
    assert mesh.warnings == ["left out 1 curv: not read"]


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.obj", "v 0 0\n", "line 1: 'v 0 0': expected three numbers"),
        ("a.obj", "v 0 0 x\n", "line 1: 'v 0 0 x': expected three numbers"),
        ("a.obj", "v 0 0 0\nv 0 0 1\nl -3 1\n", "line 3: 'l -3 1': expected the numbers of points that precede it"),
        ("a.obj", "v 0 0 0\nv 0 0 1\nl 1 3\n", "line 3: there is no point 3: the file has 2, numbered from 1"),
        ("a.obj", "v 0 0 0\nl 1 2\nl 0 1\nv 0 0 1\n", "line 3: 'l 0 1': there is no point 0: points are num"),
        ("a.obj", f"v 0 0 0\nl 1 {9**25}\n", "line 2: .*: expected the numbers of points that precede it"),
        ("a.obj", "v 0 0 0\nv 0 1e300 1\nl 1 2\n", r"1 nodes .* not numbers below 1e.150: node 1 at \(0, 1e.300, 1\)"),
        ("a.obj", "v 0 0 0\n", "has neither lines nor faces"),
        ("a.ply", "solid", "is not PLY"),
        ("a.ply", f"{HEADER}element vertex x\nend_header\n", "a line that is not known: 'element vertex x'"),
        ("a.ply", "ply\nelement vertex 0\nend_header\n", "the header has no format"),
        ("a.ply", f"{HEADER}element vertex 2\nproperty float x\nend_header\n0 1\n", "header has no 'y': expected"),
        ("a.ply", f"{HEADER}element vertex 2\nproperty float x\nend_header\n0 nan a\n", "'a' is not a number"),
        ("a.ply", f"{HEADER}element vertex 2\nproperty float x\nend_header\n0\n", "it ends early"),
        ("a.ply", f"{EDGE_OF_PLY}0 0 0\n1 0 0\n0 1.5\n", "there is no point 1.5: the file has 2, numbered from 0"),
        ("a.ply", f"{EDGE_OF_PLY}0 0 0\n1 0 0\n0 1234567\n", "there is no point 1234567: the file has 2"),
        ("a.json", "{", "is not JSON"),
        ("a.json", "[1, {}]", "has no network, graph or mesh"),
        ("a.json", '{"node": {"0": {"x": "a"}}, "edge": {}}', "node '0' has 'a' as x: expected a number"),
        ("a.json", '{"node": {"7": {"x": 0, "y": 1}}, "edge": {}}', "node '7' has no z: .* or in the default att"),
        ("a.json", f'{{"node": {AT_7}, "edge": {{"7": {{"1": {{}}}}}}}}', "edge 7-1 ends at '1', and there is no such"),
        ("a.json", f'{{"vertex": {AT_7}, "face": {{"5": [7, 8]}}}}', "face 5 ends at '8', and there is no such"),
        ("a.json", f'{{"node": {AT_7.replace("3", "9" * 400)}, "edge": {{}}}}', r"node 0 at \(1, 2, inf\)"),
        ("a.json", f'{{"node": {AT_7}, "edge": {{"7": null}}}}', "its node or edges are not what COMPAS writes"),
        ("a.vtk", "x", "cannot be read"),
        ("a.vtk", f"{VTK}LINES 2 6\n2 0 1\n2 1 9\n", "there is no point 9, at which a cell ends: the file has 3"),
        ("a.vtk", f"{VTK}LINES 2 6\n2 0 1\n2 1 -2\n", "there is no point -2, at which a cell ends: the file has 3"),
        ("a.vtk", f"{VTK}LINES 2 6\n2 0 1\n9 1 2\n", "its cells need 13 numbers, and it says that they have 6"),
        ("a.vtk", f"{VTK}LINES 1 3\n2 0 1\n".replace("0 1 0", "0 nan 0"), r"node 2 at \(0, nan, 0\)"),
    ],
)  # fmt: skip
def test_what_is_wrong(tmp_path, name, content, told):
    with pytest.raises(InputError, match=f"{name}: .*{told}"):
        read(tmp_path, content, name)


PLY = """ply
format {} 1.0
comment of own making
element vertex 5
property double x
property double y
property double z
property uchar temperature
element face 2
property list uchar int vertex_indices
property float quality
{}element other 1
property short one
end_header
"""
EDGES = "element edge 2\nproperty int vertex1\nproperty int vertex2\nproperty float area\n"
CORNERS = np.array([[0, 0, 0], [1.0 / 3.0, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]])


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("edges", [EDGES, ""])
def test_ply(tmp_path, order, edges):
    """A triangle and a square; two edges."""
    end = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    rows = [(*CORNERS[i].tolist(), 10 + i) for i in range(5)], [(3, 0, 1, 2, 0.5), (4, 0, 1, 2, 3, 0.5)]
    ends = [(0, 1, 2.5), (1, 2, 4.0)] if edges else []
    if order == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in (*rows[0], *rows[1], *ends, (7,))).encode()
    else:
        kinds = [f"{end}{kind}" for kind in ("f8", "u1", "i4", "f4", "i2")]
        real, byte, whole, single, short = (lambda *v, k=k: np.array(v, k).tobytes() for k in kinds)
        body = b"".join(real(*row[:3]) + byte(row[3]) for row in rows[0])
        body += b"".join(byte(row[0]) + whole(*row[1:-1]) + single(row[-1]) for row in rows[1])
        body += b"".join(whole(*row[:2]) + single(row[2]) for row in ends) + short(7)
    (tmp_path / "a.ply").write_bytes(PLY.format(order, edges).encode() + body)
    mesh = read_whole(tmp_path / "a.ply")
    n = 3 if edges else 4
    np.testing.assert_array_equal(mesh.points, CORNERS[:n])
    assert mesh.node_fields["temperature"].tolist() == [10, 11, 12, 13][:n]
    if edges:
        assert mesh.bars.tolist() == [[0, 1], [1, 2]] and mesh.bar_fields["area"].tolist() == [2.5, 4.0]
    else:
        assert {tuple(bar) for bar in mesh.bars.tolist()} == {(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)}
    assert any("left out 1 other" in text for text in mesh.warnings)


@pytest.mark.parametrize("name", ["a.vtp", "a.vtk", "text.vtk", "grid.vtk", "a.ply", "sphere.stl", "sphere.obj"])
def test_what_pyvista_writes(tmp_path, name):
    """Points of a sphere, and of two lines with fields and groups."""
    import pyvista

    file = tmp_path / name
    if name.startswith("sphere") or name == "a.ply":
        surface = pyvista.Icosphere(nsub=1) if name == "a.ply" else pyvista.Sphere(theta_resolution=5, phi_resolution=6)
        surface.save(file)
        mesh, again = read_whole(file), pyvista.read(file).clean()
        assert len(mesh.bars) == again.extract_all_edges().n_cells == 3 * again.n_points - 6  # Euler, of triangles
        return
    lines = pyvista.PolyData(CORNERS, lines=[3, 0, 1, 2, 2, 2, 3], faces=[3, 0, 1, 3] if name == "a.vtp" else None)
    lines.cell_data["area"] = [1.0, 2.0, 9.0][: lines.n_cells]
    lines.point_data["group"] = [0, 1, -1, 1, -1]
    lines.field_data["group_names"] = np.array(["feet", "top"])
    grid = lines.cast_to_unstructured_grid() if name == "grid.vtk" else lines
    grid.save(file, binary=name != "text.vtk")
    mesh = read_whole(file)
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [2, 3]] and mesh.bar_fields["area"].tolist() == [1.0, 1.0, 2.0]
    np.testing.assert_allclose(mesh.points[:4], CORNERS[:4], rtol=1e-9)
    assert members(mesh.node_groups) == {"feet": [0], "top": [1, 3]}
    assert len(mesh.warnings) == 2 * (name == "a.vtp")


def test_faces_of_vtk(tmp_path):
    import pyvista

    box = pyvista.Box()
    box.point_data["height"] = box.points[:, 2]
    box.cell_data["side"] = np.arange(6.0)
    box.save(tmp_path / "a.vtp")
    mesh = read_whole(tmp_path / "a.vtp")
    assert len(mesh.bars) == 12 and not mesh.bar_fields
    assert (mesh.node_fields["height"] == mesh.points[:, 2]).all()
    assert mesh.warnings == [f"{tmp_path / 'a.vtp'}: has no lines: the 12 edges of its 6 faces are bars"]


def test_the_script_for_drawings(tmp_path):
    """Of lines and polylines, with layers; other entities are told."""
    ezdxf = pytest.importorskip("ezdxf")
    drawing = ezdxf.new()
    model = drawing.modelspace()
    model.add_line((0, 0, 0), (1 / 3, 0, 0), dxfattribs={"layer": "legs"})
    model.add_polyline3d([(0, 0, 0), (0, 1, 0), (1, 1, 2)])
    model.add_lwpolyline([(0, 0), (2, 0), (2, 2)])
    model.add_circle((0, 0), 1)
    drawing.saveas(tmp_path / "a.dxf")
    (script,) = blocks(DOCS / "meshes.md", "py")
    (tmp_path / "drawing.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "drawing.py", "a.dxf", "a.obj"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "left out: CIRCLE\n"
    mesh = read_whole(tmp_path / "a.obj")
    assert mesh.bars.tolist() == [[0, 1], [2, 3], [3, 4], [5, 6], [6, 7]] and mesh.points[1, 0] == 1 / 3
    assert members(mesh.bar_groups) == {"legs": [0], "0": [1, 2, 3, 4]}


NODES = {"0": {"is_support": True}, "1": {"x": 1.0}, "2": {"y": 1.0, "z": 0.5, "load": 3}, "'a'": {"z": 2, "name": "n"}}
GRAPH = {
    "attributes": {},
    "node": NODES,
    "edge": {"0": {"1": {"q": 2.5}, "2": {}}, "2": {"'a'": {"cut": True}}, "'a'": {}},
}
MESH = {
    "attributes": {},
    "vertex": {"0": {"is_support": True}, "1": {"x": 1}, "5": {"x": 1, "y": 1}, "7": {"y": 1}},
    "face": {"0": [0, 1, 5], "1": [0, 5, 7]},
    "edgedata": {"(0, 5)": {"q": 5.0}, "1-5": {"q": 4}},
}
AT_0 = {"x": 0.0, "y": 0.0, "z": 0.0, "load": 0.0}


@pytest.mark.parametrize("version", [1, 2])
def test_networks_of_compas(tmp_path, version):
    if version == 1:
        content = {"dtype": "compas.datastructures/Network", "value": {**GRAPH, "dna": AT_0, "dea": {"q": 1.0}}}
    else:
        defaults = {"default_node_attributes": AT_0, "default_edge_attributes": {"q": 1.0}}
        content = [{"dtype": "compas.datastructures/Graph", "data": {**GRAPH, **defaults}, "guid": "x"}]
    mesh = read(tmp_path, json.dumps(content), "a.json")
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0.5], [0, 0, 2]]
    assert mesh.bars.tolist() == [[0, 1], [0, 2], [2, 3]]
    assert mesh.bar_fields["q"].tolist() == [2.5, 1.0, 1.0] and mesh.node_fields["load"].tolist() == [0, 0, 3, 0]
    assert members(mesh.node_groups) == {"is_support": [0]} and members(mesh.bar_groups) == {"cut": [2]}
    assert mesh.warnings == ["left out the attributes name: not one number for each node or edge"]


@pytest.mark.parametrize("version", [1, 2])
def test_meshes_of_compas(tmp_path, version):
    names = ("dva", "dea") if version == 1 else ("default_vertex_attributes", "default_edge_attributes")
    own = dict(zip(names, (AT_0, {"q": 1.0, "is_edge": True})))
    data = {**MESH, **own}
    content = data if version == 1 else {"form": {"dtype": "compas.datastructures/Mesh", "data": data}, "again": GRAPH}
    mesh = read(tmp_path, json.dumps(content), "a.json")
    assert mesh.bars.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert mesh.bar_fields["q"].tolist() == [1.0, 5.0, 1.0, 4.0, 1.0]
    assert members(mesh.bar_groups) == {"is_edge": [0, 1, 2, 3, 4]} and members(mesh.node_groups) == {"is_support": [0]}
    assert len(mesh.warnings) == version - 1


@pytest.mark.parallel
@pytest.mark.parametrize(("name", "content"), [("a.obj", OBJ), ("a.json", json.dumps({**MESH, "dva": AT_0}))])
def test_ranks_share_a_drawing(comm, shared_tmp_path, name, content):
    if comm.rank == 0:
        (shared_tmp_path / name).write_text(content)
    comm.Barrier()
    slab = read_slab(shared_tmp_path / name, comm)
    assert (slab.n_nodes, slab.n_bars) == ((4, 3) if name == "a.obj" else (4, 5))
    assert comm.allreduce(len(slab.points)) == 4 and comm.allreduce(len(slab.bars)) == slab.n_bars
    assert len(set(comm.allgather(tuple(slab.warnings)))) == 1
