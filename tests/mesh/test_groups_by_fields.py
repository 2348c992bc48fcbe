"""Bars and nodes by the values of fields of whole numbers, as converters leave groups."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import run

from pfem_petsc import Case, Simulation, write_mesh
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole, write_whole
from pfem_petsc.mesh.tools import cleaned, merged, refined
from pfem_petsc.mesh.whole import WholeMesh

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
BARS = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
KINDS, CORNERS = np.array([1, 1, 2, 2, 1, 7]), np.array([4, 4, -1, 9])
NAMES = ["t.h5", "t.vtu", "t.vtkhdf", "t.msh", "t_bars.csv"]

VTU = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">
<!--This file was created by meshio v5.3.5-->
<UnstructuredGrid><Piece NumberOfPoints="3" NumberOfCells="3">
<Points><DataArray type="Float64" Name="Points" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 0 1 0
</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">0 1 1 2 2 0</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">2 4 6</DataArray>
<DataArray type="Int64" Name="types" format="ascii">3 3 3</DataArray></Cells>
<CellData><DataArray type="Int64" Name="mat_id" format="ascii">1 1 2</DataArray></CellData>
</Piece></UnstructuredGrid></VTKFile>
"""


def tables(file, **more):
    return {
        "mesh": {"file": str(file)},
        "material": {"m": {"young_modulus": 2e9, "density": 1000.0, "thermal_expansion": 1e-5}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "time": {"integrator": "central_differences", "step": 1e-5, "end": 1e-4},
    } | more


def whole():
    mesh = WholeMesh(POINTS, BARS)
    mesh.bar_fields, mesh.node_fields = {"kind": KINDS.astype(float)}, {"corner": CORNERS.astype(float)}
    return mesh


@pytest.mark.slow
@pytest.mark.parallel
def test_sections_by_the_field_of_a_converter(comm, shared_tmp_path):
    file = shared_tmp_path / "integer.vtu"
    if comm.rank == 0:
        file.write_text(VTU)
    comm.Barrier()
    one, two = (
        {"area": area, "material": "m", "bars": {"field": "mat_id", "value": k}} for k, area in ((1, 1e-4), (2, 3e-4))
    )
    case = Case.from_dict(tables(file, section={"one": one, "two": two}))
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        assert simulation.model.total_mass == pytest.approx(1000.0 * (1e-4 * (1.0 + np.sqrt(2.0)) + 3e-4), rel=1e-14)
    assert str(case.section["two"].bars) == "mat_id = 2"
    assert Case.from_toml(case.to_toml()) == case
    case.section["two"].bars.value = 5
    with pytest.raises(
        InputError, match=r"section.two.bars: no bar of .*integer.vtu has mat_id = 5; .* values like 1, 2"
    ):
        Simulation(case, comm, output=shared_tmp_path / "out", quiet=True).start()


@pytest.mark.parallel
@pytest.mark.parametrize("name", NAMES)
def test_values_of_fields_are_groups_everywhere(comm, shared_tmp_path, name):
    """Sections, temperatures, removals and node sets by fields: the run is the same as by groups."""
    groups = {f"kind_{k}": np.flatnonzero(KINDS == k) for k in (1, 2, 7)}
    named = write_mesh(
        shared_tmp_path / "named.h5",
        POINTS,
        BARS,
        node_groups={"feet": [0, 1], "top": [2, 3]},
        bar_groups=groups,
        comm=comm,
    )
    if comm.rank == 0:
        write_whole(shared_tmp_path / name, whole())
    comm.Barrier()

    def case(file, group, feet, top):
        return Case.from_dict(
            tables(
                file,
                node_set={"feet": feet, "top": top},
                section={
                    "a": {"area": 1e-4, "material": "m", "bars": group(1)},
                    "b": {"area": 2e-4, "material": "m", "bars": group(2)},
                    "c": {"area": 3e-4, "material": "m"},
                },
                temperature=[{"bars": group(7), "value": 50.0}],
                remove=[{"bars": group(2), "time": 4e-5}],
                support=[{"node_set": "feet", "fix": "xyz"}],
                load=[{"node_set": "top", "force": [1.0, 2.0, 3.0]}],
            )
        )

    by_value = {"field": "corner", "value": 4}, {"field": "kind", "value": 7}  # the latter of bars: their ends
    one = case(named, lambda k: f"kind_{k}", {"group": "feet"}, {"group": "top"})
    two = case(shared_tmp_path / name, lambda k: {"field": "kind", "value": k}, *by_value)
    found, expected = (run(each, shared_tmp_path / f"out{k}", comm) for k, each in enumerate((two, one)))
    assert expected["kinetic_energy"][-1] > 0.0
    for column in ("kinetic_energy", "elastic_energy", "external_work", "removed_energy", "support_force", "momentum"):
        if column in expected:
            # PT-Scotch divides the same mesh differently in each run of a process
            scale = 0.0 if comm.size == 1 else 1e-12 * np.abs(expected[column]).max()
            np.testing.assert_allclose(found[column], expected[column], rtol=0, atol=scale, err_msg=column)


@pytest.mark.parametrize("name", NAMES)
def test_fields_of_nodes_are_kept_in_files(tmp_path, name):
    write_whole(tmp_path / name, whole())
    mesh = read_whole(tmp_path / name)
    assert mesh.node_fields["corner"].tolist() == CORNERS.tolist()
    assert mesh.bar_fields["kind"].tolist() == KINDS.tolist()
    clean, _ = cleaned(mesh)
    assert clean.node_fields["corner"].tolist() == CORNERS.tolist()
    fine = refined(mesh, 2)
    assert fine.node_fields["corner"][:4].tolist() == CORNERS.tolist()
    assert np.isnan(fine.node_fields["corner"][4:]).all()
    far = read_whole(tmp_path / name)
    far.points = far.points + 5.0
    both, _ = merged([mesh, far])
    assert both.node_fields["corner"].tolist() == [*CORNERS, *CORNERS]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"section.s.bars": {"field": "kind", "value": 3}},
            "section.s.bars: no bar of .*t.h5 has kind = 3; .* like 1, 2, 7",
        ),
        (
            {"section.s.bars": {"field": "kimd", "value": 1}},
            "section.s.bars = 'kimd': .*no field of this name .* corner, kind",
        ),
        (
            {"section.s.bars": {"field": "corner", "value": 4}},
            "section.s.bars: .*has the field 'corner' for nodes, not for bars",
        ),
        ({"section.s.bars": {"field": "kind", "value": 1.5}}, "section.s.bars.value = 1.5: expected an integer"),
        ({"section.s.bars": 3}, "section.s.bars = 3: expected the name of a bar group, or a value of a field"),
        ({"node_set.x": {"field": "corner"}}, "node_set.x: field and value need each other"),
        (
            {"node_set.x": {"field": "corner", "value": 5}},
            "node_set.x.field: no node of .* has corner = 5; .* like -1, 4, 9",
        ),
        ({"node_set.x": {"field": "corner", "value": 4, "all": True}}, "node_set.x: expected exactly one of the keys"),
    ],
)
def test_selections_that_are_refused(tmp_path, changes, text):
    write_whole(tmp_path / "t.h5", whole())
    with pytest.raises(InputError, match=text):
        case = Case.from_dict(tables(tmp_path / "t.h5"))
        case.update(changes)
        Simulation(case, output=tmp_path / "out", quiet=True).start()


def test_groups_of_gmsh_are_those_of_lines_and_points(tmp_path):
    """The tag of a surface is no group of nodes, in either version."""
    head = '$MeshFormat\n{} 0 8\n$EndMeshFormat\n$PhysicalNames\n2\n1 2 "edge"\n2 1 "plate"\n$EndPhysicalNames\n'
    two = (
        "$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n$Elements\n2\n1 1 2 2 1 1 2\n2 2 2 1 1 1 2 3\n$EndElements\n"
    )
    data = "".join(
        f'$NodeData\n1\n"{name}"\n1\n0.0\n3\n0\n1\n{n}\n{rows}\n$EndNodeData\n'
        for name, n, rows in (("kind", 3, "3 7\n1 5\n2 5"), ("part", 1, "1 2"))
    )
    entities = "$Entities\n0 1 1 0\n1 0 0 0 1 0 0 1 2 0\n1 0 0 0 1 1 0 1 1 1 1\n$EndEntities\n"
    four = (
        "$Nodes\n1 3 1 3\n2 1 0 3\n1\n2\n3\n0 0 0\n1 0 0\n0 1 0\n$EndNodes\n"
        "$Elements\n2 2 1 2\n1 1 1 1\n1 1 2\n2 1 2 1\n2 1 2 3\n$EndElements\n"
    )
    for text in (head.format("2.2") + two + data, head.format("4.1") + entities + four + data):
        (tmp_path / "t.msh").write_text(text)
        mesh = read_whole(tmp_path / "t.msh")
        assert mesh.node_groups == {}
        assert {name: members.tolist() for name, members in mesh.bar_groups.items()} == {"edge": [0]}
        assert {name: values.tolist() for name, values in mesh.node_fields.items()} == {"kind": [5.0, 5.0, 7.0]}
        told = "section $NodeData 'part' is left out: it does not have a value for each node"
        assert any(told in warning for warning in mesh.warnings)
