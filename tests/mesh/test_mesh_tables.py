"""Meshes in pairs of tables, as spreadsheets write them."""

import numpy as np
import pytest

from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole


def test_tables_as_spreadsheets_save_them(tmp_path):
    """Semicolons and decimal commas, units, texts as names of nodes, comments, a byte order mark."""
    (tmp_path / "Nodes tower.csv").write_bytes(
        "\ufeff# from a spreadsheet\r\nNode;X [m];Y [m];Groups\r\nA;0,0;0;feet\r\n".encode()
        + b'B;1,5;0;"feet; right"\r\n\r\nC;0;2;\r\n'
    )
    (tmp_path / "Bars tower.csv").write_bytes(
        b"Member;Node 1;Node 2;Area [m2];Note\r\n1;A;B;1,5e-4;short\r\n2;B;C;2e-4;long\r\n"
    )
    mesh = read_whole(tmp_path / "Bars tower.csv")
    assert mesh.points.tolist() == [[0, 0, 0], [1.5, 0, 0], [0, 2, 0]]
    assert mesh.bars.tolist() == [[0, 1], [1, 2]]
    assert mesh.bar_fields["area"].tolist() == [1.5e-4, 2e-4]
    assert {name: members.tolist() for name, members in mesh.node_groups.items()} == {"feet": [0, 1], "right": [1]}
    assert mesh.warnings == [f"{tmp_path}/Bars tower.csv: left out column 'Note', which has text other than numbers"]


TWO, BAR = "x,y\n0,0\n1,1\n", "a,b\n0,1\n"
WRONG = [
    ("x,y,z\n0,0,0\n1,0,zero\n", BAR, "nodes.csv: line 3: column 'z': 'zero' is not a number"),
    ("x,z\n0,0\n", BAR, "nodes.csv: line 1: there is no column 'y'; it has 'x', 'z'; known are y, y_coord"),
    (TWO, "a,b\n0,2\n", "bars.csv: line 2: there is no node '2' in t_nodes.csv"),
    ("x,y\n0,0\n1\n", BAR, "nodes.csv: line 3: 1 entries; expected 2"),
    ("node,x,y\n7,0,0\n7,1,0\n", "a,b\n7,7\n", "line 3: node '7' is listed more than once in column 'node'"),
    ("node,x,y\n7,0,0\n8,1,0\n", "a,b\n7,9\n", "no node '9' in t_nodes.csv, whose ids are in column 'node', like 7, 8"),
    (TWO, "a,b\n1,2\n", "numbered from 0, because it has no column of ids"),
    ("x,y,knotennr\n0,0,2\n1,0,0\n0,1,1\n", "a,b\n0,1\n1,2\n", "column 'knotennr' may have the ids of nodes"),
    ("id,index,x,y\n1,0,0,0\n0,1,1,1\n", BAR, "columns 'id' and 'index' may all be the ids of nodes"),
    (TWO, "one,two\n0,1\n", "no two columns for the ends of bars; it has 'one', 'two'; known are node1"),
    (TWO, "i,j,a,b\n0,1,1,0\n", "'i' and 'j', 'a' and 'b' may be the ends of bars"),
    ("", BAR, "nodes.csv: is empty"),
    ('x,y\n"0,0\n1,1\n', BAR, "nodes.csv"),
    (b"\xff\xfe\x00", BAR, "nodes.csv: cannot be read"),
]


@pytest.mark.parametrize(("nodes", "bars", "text"), WRONG)
def test_tables_with_one_thing_wrong(tmp_path, nodes, bars, text):
    (tmp_path / "t_nodes.csv").write_bytes(nodes if isinstance(nodes, bytes) else nodes.encode())
    (tmp_path / "t_bars.csv").write_text(bars)
    with pytest.raises(InputError, match=text):
        read_whole(tmp_path / "t_nodes.csv")


def test_a_table_without_a_pair(tmp_path):
    (tmp_path / "t.csv").write_text("x,y\n")
    with pytest.raises(InputError, match="t_nodes.csv and t_bars.csv: there is no table of bars beside it"):
        read_whole(tmp_path / "t.csv")
    (tmp_path / "t.csv").write_text("p,q\n")
    with pytest.raises(InputError, match="is a pair of files, t_nodes.csv and t_bars.csv: name one of them"):
        read_whole(tmp_path / "t.csv")


def pair(folder, nodes, bars, names=("nodes.csv", "bars.csv")):
    """Write two tables, and return the mesh that they give, read by either."""
    for name, text in zip(names, (nodes, bars)):
        (folder / name).write_text(text)
    meshes = [read_whole(folder / name) for name in names]
    assert meshes[0].bars.tolist() == meshes[1].bars.tolist()
    return meshes[0]


def test_the_ends_are_one_pair(tmp_path):
    """Areas and moments have letters that may be ends as well."""
    nodes = "node,x,y\n1,0,0\n2,1,0\n3,1,1\n"
    mesh = pair(tmp_path, nodes, "node1,node2,A\n1,2,1\n2,3,1\n")
    assert mesh.bars.tolist() == [[0, 1], [1, 2]]
    assert mesh.bar_fields["A"].tolist() == [1.0, 1.0]
    for ends in ("i,j", "start,end", "n1,n2", "u,v", "from_node,to_node", "a,I_node,J_node"):
        extra = ends.count(",") == 2
        row = "3,{},{},5e-4,1,2,7" if extra else "{},{},5e-4,1,2,7"
        rows = "\n".join(row.format(*each) for each in ((1, 2), (3, 2)))
        mesh = pair(tmp_path, nodes, f"{ends},A,b,I,J\n{rows}\n")
        assert mesh.bars.tolist() == [[0, 1], [2, 1]], ends
        assert {name: values[0] for name, values in mesh.bar_fields.items()} == {
            **({"a": 3.0} if extra else {}),
            "A": 5e-4,
            "b": 1.0,
            "I": 2.0,
            "J": 7.0,
        }


NODE_IDS = ["node_id", "nid", "id", "ID", "Node", "index", "NodeNo", "Node ID", "node number", "Node #", "label", "No."]
NODE_IDS += ["nodes_key", "point", "vertex id", "Joint", "Number", "tag", "n", "", "Unnamed: 0", "GRID"]


@pytest.mark.parametrize("name", NODE_IDS)
def test_ids_of_nodes_under_the_names_that_programs_write(tmp_path, name):
    if name == "nodes_key":
        name = "node_key"
    mesh = pair(
        tmp_path, f"{name},x,y,z\n2,2,0,0\n0,0,0,0\n1,1,0,0\n3,3,0,0\n", "bar,first,second\n0,0,1\n1,1,2\n2,2,3\n"
    )
    assert np.diff(mesh.points[mesh.bars][:, :, 0], axis=1).ravel().tolist() == [1.0, 1.0, 1.0]
    assert mesh.node_fields == {}
    assert mesh.warnings == []


ENDS = ["u,v", "ni,nj", "i_node,j_node", "start,end", "from,to", "from_node,to_node", "node1,node2", "n1,n2", "N_1,N_2"]
ENDS += [
    "start_node_id,end_node_id",
    "Node I,Node J",
    "node_a,node_b",
    "source,target",
    "nodeStart,nodeEnd",
    "first,second",
]
ENDS += [
    "JointI,JointJ",
    "UniquePtI,UniquePtJ",
    "GA,GB",
    "v1,v2",
    "end_1,end_2",
    "start_id,end_id",
    "I,J",
    "point_0,point_1",
]


@pytest.mark.parametrize("names", ENDS)
def test_ends_of_bars_under_the_names_that_programs_write(tmp_path, names):
    mesh = pair(tmp_path, "id,x,y\n5,0,0\n6,1,0\n7,0,1\n", f"id,{names},E\n1,5,7,2\n2,7,6,3\n")
    assert mesh.bars.tolist() == [[0, 2], [2, 1]]
    assert {name: values.tolist() for name, values in mesh.bar_fields.items()} == {"E": [2.0, 3.0]}


@pytest.mark.parametrize(
    "axes", ["X (m),Y (m),Z (m)", "x_coord,y_coord,z_coord", "coordX,coordY,coordZ", "x_m,y_m,z_m"]
)
def test_coordinates_under_other_names(tmp_path, axes):
    mesh = pair(tmp_path, f"id,{axes}\nA,1,2,3\nB,4,5,6\n", "from,to\nA,B\n")
    assert mesh.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert mesh.warnings == []


def test_a_header_of_numpy_and_units_that_are_not_metres(tmp_path):
    nodes, bars = "# id, x [mm], y [mm]\n4, 1000, 0\n5, 0, 0\n", "#i,j,area [mm2],B (m2)\n4,5,100,1\n"
    mesh = pair(tmp_path, nodes, bars)
    assert mesh.bars.tolist() == [[0, 1]] and mesh.bar_fields["area"].tolist() == [100.0]
    texts = (
        "has 'x' in mm, 'y' in mm, whose numbers are taken",
        "has 'area' in mm2, whose numbers are taken as they are",
    )
    assert all(text in warning for text, warning in zip(texts, mesh.warnings, strict=True))


def test_names_of_nodes_or_their_numbers(tmp_path):
    """Which of two columns of ids bars refer to shows in the table of bars."""
    nodes = "id,name,x,y\n3,A,0,0\n1,B,1,0\n2,C,0,1\n"
    assert pair(tmp_path, nodes, "from,to\nA,C\n").bars.tolist() == [[0, 2]]
    assert pair(tmp_path, nodes, "from,to\n1,3\n").bars.tolist() == [[1, 0]]


def test_fields_of_nodes_and_what_is_left_out(tmp_path):
    mesh = pair(tmp_path, "node,x,y,kind,remark\n1,0,0,7,a\n2,1,0,8,b\n", "from,to\n1,2\n")
    assert mesh.node_fields["kind"].tolist() == [7.0, 8.0]
    (told,) = mesh.warnings
    assert "left out columns 'remark'" in told
    assert "has no column z: all nodes have z = 0; known are x, y, z, groups, and for ids node, node_id" in told


NAMES = [("nodes", "elements"), ("Nodes", "Members"), ("points", "edges"), ("vertices", "lines"), ("joints", "frames")]
NAMES += [("tower_node", "tower_element"), ("nodes_frame", "bars_frame"), ("pipeline nodes", "pipeline bars")]
NAMES += [("knoten", "staebe"), ("a", "b")]


@pytest.mark.parametrize("names", NAMES, ids="-".join)
def test_pairs_of_files_with_other_names(tmp_path, names):
    files = [f"{name}.csv" for name in names]
    (tmp_path / "history.csv").write_text("time,energy\n0,1\n")
    mesh = pair(tmp_path, "id,x,y\n1,0,0\n2,1,0\n", "i,j\n1,2\n", files)
    assert mesh.bars.tolist() == [[0, 1]]
    by_columns = names[0] in ("knoten", "a")
    assert any("by the columns of both" in text for text in mesh.warnings) == by_columns


def test_several_tables_that_fit(tmp_path):
    pair(tmp_path, "id,x,y\n1,0,0\n2,1,0\n", "i,j\n1,2\n", ("t_nodes.csv", "t_bars.csv"))
    (tmp_path / "t_members.csv").write_text("i,j\n2,1\n")
    assert read_whole(tmp_path / "t_members.csv").bars.tolist() == [[1, 0]]
    with pytest.raises(InputError, match="it may go with t_bars.csv, t_members.csv: name the table of bars"):
        read_whole(tmp_path / "t_nodes.csv")
