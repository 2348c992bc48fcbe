"""Meshes in pairs of tables, as spreadsheets write them."""

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
    with pytest.raises(InputError, match="there is no such file, the other table"):
        read_whole(tmp_path / "Bars tower.csv")
    (tmp_path / "Nodes tower.csv").rename(tmp_path / "nodes tower.csv")
    (tmp_path / "Bars tower.csv").rename(tmp_path / "bars tower.csv")
    mesh = read_whole(tmp_path / "bars tower.csv")
    assert mesh.points.tolist() == [[0, 0, 0], [1.5, 0, 0], [0, 2, 0]]
    assert mesh.bars.tolist() == [[0, 1], [1, 2]]
    assert mesh.bar_fields["area"].tolist() == [1.5e-4, 2e-4]
    assert {name: members.tolist() for name, members in mesh.node_groups.items()} == {"feet": [0, 1], "right": [1]}
    assert mesh.warnings == [f"{tmp_path}/bars tower.csv: left out column 'Note', which has text other than numbers"]


@pytest.mark.parametrize(
    ("nodes", "bars", "text"),
    [
        ("x,y,z\n0,0,0\n1,0,zero\n", "a,b\n0,1\n", "nodes.csv: line 3: column 'z': 'zero' is not a number"),
        ("x,z\n0,0\n", "a,b\n0,1\n", "nodes.csv: line 1: there is no column 'y'; it has 'x', 'z'"),
        ("x,y\n0,0\n1,1\n", "a,b\n0,2\n", "bars.csv: line 2: there is no node '2' in t_nodes.csv"),
        ("x,y\n0,0\n1\n", "a,b\n0,1\n", "nodes.csv: line 3: 1 entries; expected 2"),
        ("node,x,y\n7,0,0\n7,1,0\n", "a,b\n7,7\n", "nodes.csv: line 3: node '7' is listed more than once"),
        ("", "a,b\n0,1\n", "nodes.csv: is empty"),
        ('x,y\n"0,0\n1,1\n', "a,b\n0,1\n", "nodes.csv"),
        (b"\xff\xfe\x00", "a,b\n0,1\n", "nodes.csv: cannot be read"),
    ],
)
def test_tables_with_one_thing_wrong(tmp_path, nodes, bars, text):
    (tmp_path / "t_nodes.csv").write_bytes(nodes if isinstance(nodes, bytes) else nodes.encode())
    (tmp_path / "t_bars.csv").write_text(bars)
    with pytest.raises(InputError, match=text):
        read_whole(tmp_path / "t_nodes.csv")


def test_a_table_without_a_pair(tmp_path):
    (tmp_path / "t.csv").write_text("x,y\n")
    with pytest.raises(InputError, match="is a pair of files, t_nodes.csv and t_bars.csv: name one of them"):
        read_whole(tmp_path / "t.csv")
