"""Expressions of lattices: arithmetic, what is refused, fields of other meshes, and nodes that are kept."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers.meshes import assert_part_of, whole
from mpi4py import MPI
from pydantic import ValidationError

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.generators.lattice.expressions import Expression

ROOT = Path(__file__).parents[2]


def generated(comm=MPI.COMM_SELF, wanted=(), **keys):
    keys = {"kind": "octet", "pitch": 0.25, "cells": (4, 4, 4)} | keys
    return lattice.generate_on(lattice.Parameters(**keys), comm, dict.fromkeys(wanted, "section.s"), None)


X, Y, Z = 0.3, -1.2, 2.5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1e-6*(1 + 2*exp(-z/0.1))", 1e-6 * (1.0 + 2.0 * math.exp(-25.0))),
        ("-x**2", -(X**2)),
        ("2**-1 + +y/x - 3", 0.5 + Y / X - 3.0),
        ("where(x < 0.5 and y < 0, 7, 8)", 7.0),
        ("where(0 < y < 1 or not (z >= 2.5), 7, 8)", 8.0),
        ("min(x, y, z) + max(x, y)", Y + X),
        ("atan2(y, x) + hypot(x, y) + abs(y) + sign(y)", math.atan2(Y, X) + math.hypot(X, Y) - Y - 1.0),
        ("sqrt(z)*log10(z)*log(z)*floor(z)*ceil(z)", math.sqrt(Z) * math.log10(Z) * math.log(Z) * 6.0),
        ("sin(x) + cos(x) + tan(x) + asin(x) + acos(x) + atan(x)", None),
        ("sinh(x) + cosh(x) + tanh(x) + pi + e", None),
        ("(x == 0.3) + (y != 0.3)", 2.0),
        ("5", 5.0),
    ],
)
def test_values(text, expected):
    if expected is None:  # plain functions of the same names
        names = {name: getattr(math, name) for name in dir(math)}
        expected = eval(text, {"__builtins__": {}}, names | {"x": X})
    found = Expression(text, ("x", "y", "z"))({"x": np.full(3, X), "y": np.full(3, Y), "z": np.full(3, Z)})
    np.testing.assert_allclose(found, np.full(3, expected), rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not an expression"),
        ("1 +", "not an expression"),
        ("__import__('os')", "unknown function '__import__'"),
        ("x.real", "not arithmetic"),
        ("(lambda: 1)()", "not arithmetic"),
        ("[x for x in y]", "not arithmetic"),
        ("x[0]", "not arithmetic"),
        ("'text'", "is not a number"),
        ("True", "is not a number"),
        ("1j", "is not a number"),
        ("w + 1", "unknown variable 'w'; known: x, y, z, pi, e"),
        ("sin", "unknown variable 'sin'"),
        ("sin(x, y)", "sin takes 1 argument, got 2"),
        ("where(x, y)", "where takes 3 arguments, got 2"),
        ("max(x)", "max takes two or more arguments"),
        ("max(x, axis=0)", "max takes two or more"),
        ("x // 2", "this operator is not known"),
        ("x @ y", "this operator is not known"),
        ("x ^ 2", r"this operator is not known; powers are \*\*"),
        ("x if y else z", "not arithmetic"),
        ("x+" * 1500 + "x", "more than 2000"),
        ("10**400", None),
        ("9**9**9**9", None),
        ("1" * 400, "is not a number"),
    ],
)
def test_what_is_no_arithmetic_is_refused(text, why):
    if why is None:  # computed in double precision, in no time
        assert not np.isfinite(Expression(text, ("x",))({"x": np.zeros(1)})).any()
        return
    with pytest.raises(ValueError, match=why):
        Expression(text, ("x", "y", "z"))


@pytest.mark.parametrize("text", ["(" * 500 + "x" + ")" * 500, "-" * 1900 + "x"])
def test_deep_nesting_is_computed_or_refused(text):
    """Which of both depends on the version of Python."""
    try:
        assert Expression(text, ("x",))({"x": np.ones(1)}) == 1.0
    except ValueError as error:
        assert re.match("not an expression|the expression is nested too deep", str(error))


def write_grid(path, cells=False):
    """A grid from 0 to 1.2 m, in decimetres, whose field is 2 x - y + 3 z + 0.5 with x in metres."""
    import pyvista

    grid = pyvista.ImageData(dimensions=(4, 4, 4), spacing=(4.0, 4.0, 4.0))
    points = (grid.cell_centers().points if cells else grid.points) / 10.0
    (grid.cell_data if cells else grid.point_data)["density"] = points @ np.array([2.0, -1.0, 3.0]) + 0.5
    grid.field_data["note"] = [1.0]
    grid.save(path)
    return path


def test_field_of_points_is_interpolated(tmp_path):
    field = {"file": str(write_grid(tmp_path / "grid.vti")), "array": "density", "scale": 0.1}
    keys = {"fields": {"rho": field}, "bar_fields": {"area": "1e-6*rho + where(x > 9, 1, 0)"}}
    mesh = generated(wanted=["area"], **keys)
    middles = mesh.points[mesh.bars].mean(axis=1)
    np.testing.assert_allclose(
        mesh.bar_fields["area"], 1e-6 * (middles @ [2.0, -1.0, 3.0] + 0.5), rtol=1e-5, atol=1e-15
    )


def test_field_of_cells_and_points_outside(tmp_path):
    field = {"file": str(write_grid(tmp_path / "grid.vti", cells=True)), "array": "density", "scale": 0.1}
    keys = {"fields": {"rho": field}, "bar_fields": {"a": "rho"}, "origin": [0.0, 0.0, 0.5]}
    mesh = generated(wanted=["a"], **keys)
    middles = mesh.points[mesh.bars].mean(axis=1)
    inside = (middles < 1.2).all(axis=1)
    clear = inside & (np.abs(middles / 0.4 - np.round(middles / 0.4)) > 1e-6).all(axis=1)
    centre = 0.4 * (np.floor(middles / 0.4) + 0.5)
    expected = centre @ [2.0, -1.0, 3.0] + 0.5
    np.testing.assert_allclose(mesh.bar_fields["a"][clear], expected[clear], rtol=1e-6)
    assert np.isfinite(mesh.bar_fields["a"]).all()
    assert mesh.bar_fields["a"][~inside].max() <= expected[inside].max() + 1e-6


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ({"file": "grid.vti", "array": "mass"}, "mesh.fields.rho.array = 'mass': .*; it has density"),
        ({"file": "absent.vti", "array": "density"}, "mesh.fields.rho.file: .*absent.vti: cannot open"),
        ({"file": "text.vtu", "array": "density"}, "mesh.fields.rho"),
    ],
)
def test_fields_that_are_refused(tmp_path, field, text):
    write_grid(tmp_path / "grid.vti")
    (tmp_path / "text.vtu").write_text("nothing")
    field = field | {"file": str(tmp_path / field["file"])}
    with pytest.raises(InputError, match=text):
        generated(wanted=["a"], fields={"rho": field}, bar_fields={"a": "rho"})


@pytest.mark.parametrize("name", ["x", "sin", "a b", "and", "1a"])
def test_names_of_fields_are_checked(name):
    with pytest.raises(ValidationError, match="expected a name of letters"):
        generated(fields={name: {"file": "a.vti", "array": "a"}})


def test_files_are_relative_to_the_case(tmp_path):
    """Of fields and of the surface."""
    write_grid(tmp_path / "grid.vti")
    mesh = {"generator": "lattice", "cells": [2, 2, 2], "pitch": 0.1, "bar_fields": {"a": "1e-6*rho"}}
    mesh |= {"fields": {"rho": {"file": "grid.vti", "array": "density"}}, "surface": {"file": "cube.stl"}}
    case = {
        "mesh": mesh,
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area_field": "a", "material": "m"}},
        "time": {"integrator": "central_differences", "step": "auto", "end": 1e-5},
    }
    read = Case.from_dict(case, folder=tmp_path)
    assert read.mesh.parameters.fields["rho"].file == str((tmp_path / "grid.vti").resolve())
    assert read.mesh.parameters.surface.file == str((tmp_path / "cube.stl").resolve())
    assert Case.from_toml(read.to_toml()).mesh == read.mesh


BLOCKS = re.findall(r"^```toml\n(.*?)^```$", (ROOT / "docs" / "lattices.md").read_text(), re.MULTILINE | re.DOTALL)
BLOCKS = [block for block in BLOCKS if "[static]" not in block]  # whole cases are run by test_lattice_surfaces.py


@pytest.mark.parametrize("block", range(len(BLOCKS)))
def test_examples_of_the_page_about_lattices_are_read(tmp_path, block):
    """Each block as it is printed, with fewer cells, and what it leaves out of a case."""
    import pyvista

    grid = pyvista.ImageData(dimensions=(3, 3, 3), spacing=(100.0, 50.0, 25.0))  # in millimetres
    grid.point_data["rho"] = np.full(27, 0.5)
    grid.save(tmp_path / "density.vti")
    case = tomllib.loads(BLOCKS[block])
    case["mesh"]["cells"] = [3, 3, 3]
    case.setdefault("section", {"strut": {"area": 1e-7, "material": "titanium"}})
    if "area" in case["mesh"].get("bar_fields", {}):
        case["section"]["strut"] = {"area_field": "area", "material": "titanium"}
    case["material"] = {"titanium": {"young_modulus": 110e9, "density": 4500.0}}
    case["time"] = {"integrator": "central_differences", "step": "auto", "end": 1e-6}
    simulation = Simulation(Case.from_dict(case, folder=tmp_path), MPI.COMM_SELF, check_only=True)
    assert simulation.mesh.n_bars > 100


@pytest.mark.parallel
@pytest.mark.parametrize("more", [{}, {"keep": "x + y + z < 1.5"}, {"kind": "diamond"}])
def test_nodes_go_where_the_map_says(comm, more):
    keys = {"map": ["x*(1 - 0.5*z)", "y + 0.1*sin(x)", "z"], "origin": [0.0, 0.0, 0.2], **more}
    mesh = assert_part_of(generated(comm, **keys), generated(**keys), comm)
    block = generated(origin=[0.0, 0.0, 0.2])
    if not more:
        x, y, z = block.points.T
        np.testing.assert_allclose(
            mesh.points, np.stack([x * (1 - 0.5 * z), y + 0.1 * np.sin(x), z], axis=1), rtol=1e-14
        )
    with pytest.raises(InputError, match=r"mesh.map\[1\] = 'sqrt\(x - 0.5\)' has no finite value at"):
        generated(comm, **(more | {"map": ["x", "sqrt(x - 0.5)", "z"]}))


def test_a_map_that_makes_nodes_meet_is_refused():
    from pfem_petsc.case.model import Mesh
    from pfem_petsc.mesh import load_slab

    keys = lattice.Parameters(kind="cubic", cells=(2, 2, 2), pitch=0.5, map=("x", "y", "max(z, 0.5)"))
    with pytest.raises(InputError, match="bars have a length that is zero"):
        load_slab(Mesh(generator="lattice", parameters=keys), MPI.COMM_SELF)


def test_a_mapped_block_is_cut_to_a_surface(tmp_path):
    """Struts that a shear makes longer than those of the cell: none reaches out of the surface."""
    import pyvista

    pyvista.Box((0.0, 1.0, 0.0, 1.0, 0.0, 1.0)).triangulate().save(tmp_path / "box.stl")
    keys = {"surface": {"file": str(tmp_path / "box.stl")}, "map": ["x + 2*z - 0.5", "y", "z"], "dangling": "keep"}
    mesh = generated(cells=(8, 4, 4), **keys)
    block = generated(cells=(8, 4, 4))
    x = block.points @ [1.0, 0.0, 2.0] - 0.5
    inside = (x >= 0.0) & (x <= 1.0)
    assert mesh.n_bars == np.count_nonzero(inside[block.bars].all(axis=1)) > 100


@pytest.mark.parallel
def test_nodes_are_kept_by_an_expression(comm, shared_tmp_path):
    """A ball of nodes in a block; the group surface has those that have lost a strut."""
    keys = {"keep": "(x - 0.5)**2 + (y - 0.5)**2 + (z - 0.5)**2 < 0.2", "cells": (4, 4, 4)}
    mesh = whole(generated(comm, **keys), comm)
    block = generated()
    inside = ((block.points - 0.5) ** 2).sum(axis=1) < 0.2
    bars = inside[block.bars].all(axis=1)
    assert mesh.n_bars == np.count_nonzero(bars)
    assert mesh.n_nodes == len(np.unique(block.bars[bars]))
    lost = np.bincount(mesh.bars.ravel(), minlength=mesh.n_nodes) < 12
    np.testing.assert_array_equal(np.sort(mesh.node_groups["surface"]), np.flatnonzero(lost))
    with pytest.raises(InputError, match=r"mesh.keep = 'log\(x - 1\)' has no finite value at"):
        generated(comm, keep="log(x - 1)")
