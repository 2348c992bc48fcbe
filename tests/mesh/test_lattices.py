"""Lattices: counts, joints, densities and mechanisms of the kinds; ranks, and keys that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.meshes import OCTET, assert_part_of, degrees, generated, lengths, stiffness_modes
from mpi4py import MPI
from pydantic import ValidationError

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.generators.lattice.cells import periodic_mechanisms

SIZES = [(1, 1, 1), (2, 3, 4)]


def faces(a, b, c):
    return (a + 1) * b * c + a * (b + 1) * c + a * b * (c + 1)


def corners(a, b, c):
    return (a + 1) * (b + 1) * (c + 1)


def edges(a, b, c):
    return a * (b + 1) * (c + 1) + (a + 1) * b * (c + 1) + (a + 1) * (b + 1) * c


COUNTS = {  # nodes and bars of a x b x c cells
    "cubic": lambda a, b, c: (corners(a, b, c), edges(a, b, c) + 2 * faces(a, b, c)),
    "bcc": lambda a, b, c: (corners(a, b, c) + a * b * c, edges(a, b, c) + 8 * a * b * c),
    "octet": lambda a, b, c: (corners(a, b, c) + faces(a, b, c), 4 * faces(a, b, c) + 12 * a * b * c),
    "fcc": lambda a, b, c: (corners(a, b, c) + faces(a, b, c), 4 * faces(a, b, c)),
    "bcc_diagonals": lambda a, b, c: (corners(a, b, c) + a * b * c, 8 * a * b * c),
    "kelvin": lambda a, b, c: (4 * faces(a, b, c), 4 * faces(a, b, c) + 12 * a * b * c),
    # four corners of the block have no neighbour inside
    "diamond": lambda a, b, c: (corners(a, b, c) + faces(a, b, c) + 4 * a * b * c - 4, 16 * a * b * c),
    # two struts a cell pass each face of the block; the node at one corner has all of its three cut off
    "gyroid": lambda a, b, c: (8 * a * b * c - 1, 12 * a * b * c - 2 * (a * b + b * c + c * a)),
    "auxetic": lambda a, b, c: (
        2 * c * (2 * a + 1) * (2 * b + 1),
        c * ((a + 1) * (b + 1) + a * b)
        + (c - 1) * (a * (b + 1) + (a + 1) * b)
        + 2 * c * (2 * a * (2 * b + 1) + 2 * b * (2 * a + 1)),
    ),
}
NEIGHBOURS = {  # of nodes inside
    "cubic": {18},
    "octet": {12},
    "bcc": {8, 14},
    "bcc_diagonals": {8},
    "fcc": {4, 12},
    "kelvin": {4},
    "diamond": {4},
    "gyroid": {3},
    "auxetic": {5},
    "tetrahedral_octahedral": {12},
}


@pytest.mark.parametrize("cells", SIZES)
@pytest.mark.parametrize("kind", COUNTS)
def test_counts(kind, cells):
    mesh = generated(kind=kind, cells=cells)
    assert (mesh.n_nodes, mesh.n_bars) == COUNTS[kind](*cells)


@pytest.mark.parametrize("kind", NEIGHBOURS)
def test_nodes_inside_have_all_their_struts(kind):
    mesh = generated(kind=kind, cells=(4, 4, 9 if "tetra" in kind else 4), pitch=1.0)
    middle = 0.5 * (mesh.points.max(axis=0) + mesh.points.min(axis=0))
    inside = (np.abs(mesh.points - middle) <= 1.01).all(axis=1)
    assert set(degrees(mesh)[inside].tolist()) == NEIGHBOURS[kind]
    assert sum(map(len, mesh.bar_groups.values())) == mesh.n_bars


@pytest.mark.parametrize("kind", ["octet", "kelvin", "diamond", "gyroid", "tetrahedral_octahedral", "bcc_diagonals"])
def test_struts_join_all_pairs_at_their_length(kind):
    mesh = generated(kind=kind, cells=(2, 2, 3), pitch=1.0)
    length = lengths(mesh)
    np.testing.assert_allclose(length, length[0], rtol=1e-12)
    apart = np.linalg.norm(mesh.points[:, None] - mesh.points[None], axis=2)
    assert mesh.n_bars == np.count_nonzero(np.abs(apart - length[0]) < 1e-9) / 2


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        # rho = C A/l^2 with bar area A and length l
        ("octet", 6.0 * np.sqrt(2.0)),  # Deshpande, Fleck, Ashby, J. Mech. Phys. Solids 49 (2001): 6 sqrt(2) pi (r/l)^2
        ("tetrahedral_octahedral", 6.0 * np.sqrt(2.0)),  # the same lattice
        ("kelvin", 1.06),  # Gibson, Ashby, Cellular Solids (1997): 1.06 (t/l)^2
        ("bcc_diagonals", 3.0 * np.sqrt(3.0)),  # sqrt(3) pi (d/a)^2, Ushijima et al., J. Sandw. Str. 13 (2011)
        ("diamond", 3.0 * np.sqrt(3.0) / 4.0),  # 2 bars a node; 8 nodes in (4 l/sqrt(3))^3
        ("gyroid", 3.0 * np.sqrt(2.0) / 8.0),  # 3/2 bars a node; 8 nodes in (2 sqrt(2) l)^3
    ],
)
def test_relative_density(kind, expected):
    cell = lattice.Parameters(kind=kind, cells=(1, 1, 1), pitch=1.0).unit_cell()
    length = np.linalg.norm(cell.vectors, axis=1)
    density = length.sum() / np.prod(cell.aspect)
    assert density * length[0] ** 2 == pytest.approx(expected, rel=1e-3)
    # of a large block: the surface adds its share, which falls with the size
    mesh = generated(kind=kind, cells=(12, 12, 36 if "tetra" in kind else 12), pitch=1.0)
    assert lengths(mesh).sum() / mesh.volume == pytest.approx(density, rel=0.12)


@pytest.mark.parametrize(
    ("kind", "mechanism"),
    [(kind, kind not in ("cubic", "octet", "bcc", "tetrahedral_octahedral")) for kind in NEIGHBOURS],
)
def test_mechanisms(kind, mechanism):
    keys = {"kind": kind, "cells": (2, 2, 6 if "tetra" in kind else 2), "pitch": 1.0}
    cell = lattice.Parameters(**keys).unit_cell()
    assert (sum(periodic_mechanisms(cell)) > 0) == mechanism
    mesh = generated(**keys)
    assert ("is a mechanism" in " ".join(mesh.warnings)) == mechanism
    assert (stiffness_modes(mesh.points, mesh.bars) > 6) == mechanism


def test_periodic_mechanisms_of_known_lattices():
    def modes(kind):
        return periodic_mechanisms(lattice.Parameters(kind=kind, cells=(1, 1, 1), pitch=1.0).unit_cell())

    # struts along the space diagonals sense the sum of the three strains and the shears: two strains without sum remain
    assert modes("bcc_diagonals")[0] == 2
    # Maxwell's rule, at least: 3 x 12 - 24 + 6 strains - 3 translations in each cell
    assert modes("kelvin")[0] >= 15
    assert modes("octet") == (0, 0)


def test_struts_of_the_auxetic_kind_turn_without_stretch():
    """Wider and higher at once: with a smaller angle the same struts fill a larger cell in both directions."""

    def sides(angle):
        """Width and height of the cell with inclined struts of length 1 and vertical ones of 1.5."""
        slope = np.radians(angle)
        return 2.0 * np.cos(slope), 2.0 * (1.5 - np.sin(slope))

    for angle in (30.0, 20.0):
        width, height = sides(angle)
        # of the cell of the generator, inclined struts rise by (2 h - 1)/2 of its height, where h = 1.5/height
        own = np.degrees(np.arctan(3.0 / height - 1.0))
        mesh = generated(kind="auxetic", cells=(2, 2, 2), pitch=1.0, angle=own, grading=[width, width, height])
        np.testing.assert_allclose(lengths(mesh)[mesh.bar_groups["inclined"]], 1.0, rtol=1e-12)
        np.testing.assert_allclose(lengths(mesh)[mesh.bar_groups["vertical"]], 1.5, rtol=1e-12)
    assert all(np.array(sides(20.0)) > np.array(sides(30.0)))


CASES = {
    "diamond": {"kind": "diamond", "cells": (3, 2, 2)},
    "gyroid": {"kind": "gyroid", "cells": (2, 3, 2)},
    "kelvin": {"kind": "kelvin", "cells": (1, 1, 5), "perturbation": 0.05},
    "auxetic": {"kind": "auxetic", "cells": (3, 1, 2), "grading": [1, "1 + y", 2]},
    "layers": {"kind": "tetrahedral_octahedral", "cells": (2, 2, 4)},
    "missing": {"kind": "octet", "cells": (3, 3, 2), "missing": 0.3, "seed": 1, "perturbation": 0.1},
    "ring": {"kind": "fcc", "cells": (5, 2, 1), "curved": {"shape": "cylinder", "radius": 0.3, "closed": True}},
    "own": {"kind": "cell", "cells": (2, 1, 2), "cell": OCTET},
}


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_every_rank_makes_its_part_of_the_same_sound_lattice(comm, name):
    keys = CASES[name] | {"bar_fields": {"area": "1e-6*(1 + x + where(z > 0.1, y, 0))"}}
    alone = generated(MPI.COMM_SELF, ["area"], **keys)
    assert_part_of(generated(comm, ["area"], **keys), alone, comm)
    middle = alone.points[alone.bars].mean(axis=1)
    expected = 1e-6 * (1.0 + middle[:, 0] + np.where(middle[:, 2] > 0.1, middle[:, 1], 0.0))
    if "curved" not in keys:
        np.testing.assert_allclose(alone.bar_fields["area"], expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"kind": "cell"}, "need each other"),
        ({"cells": None}, "the key cells is missing"),
        ({"angle": 10.0}, 'angle belongs to kind = "auxetic"'),
        ({"seed": 1}, "seed needs"),
        ({"kind": "auxetic", "angle": 50.0}, "less than 45"),
        ({"grading": [1, 1]}, "three factors"),
        ({"grading": [1, 1, "x"]}, "unknown variable 'x'; known: z"),
        ({"grading": [1, 1, -1.0]}, "a factor > 0"),
        ({"bar_fields": {"area": "open('f')"}}, "unknown function 'open'"),
        ({"kind": "cell", "cell": {"points": [[0, 0, 0.0]], "struts": [[0, 1]]}}, "two numbers of points, 0 to 0"),
        ({"kind": "cell", "cell": {"points": [[0, 0, 2.0]], "struts": []}}, "less than or equal to 1"),
        ({"kind": "cell", "cell": {"points": [[0, 0, 0.0], [1, 1, 1.0]], "struts": [[0, 0]]}}, "no length"),
        ({"kind": "cell", "cell": {"points": [[0, 0, 0.0], [0.5, 0, 0]], "struts": [[0, 0, 1, 0, 0]]}}, "no strut"),
        ({"curved": {"shape": "sphere", "radius": 1.0, "closed": True}}, "cylinder"),
        ({"cells": [2, 1, 1], "curved": {"shape": "cylinder", "radius": 1.0, "closed": True}}, "3 cells or more"),
    ],
)
def test_keys_are_checked(keys, text):
    with pytest.raises(ValidationError, match=text.replace("(", r"\(")):
        lattice.Parameters(**({"cells": [1, 1, 1], "pitch": 1.0} | keys))


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"grading": [1, 1, "where(z < 2, 1, -1)"]}, r"mesh.grading\[2\]: .* is -1 at z = 2"),
        ({"perturbation": 0.3}, "choose less than 0.2041"),
        ({"curved": {"shape": "cylinder", "radius": 0.4}}, "more than the circumference"),
        ({"curved": {"shape": "sphere", "radius": 0.4}}, "of the sphere"),
        ({"bar_fields": {"area": "log(x - 9)"}}, "has no finite value at"),
    ],
)
def test_blocks_are_checked(keys, text):
    with pytest.raises(InputError, match=text):
        generated(
            fields=list(keys.get("bar_fields", ())), **({"kind": "octet", "cells": [4, 1, 4], "pitch": 1.0} | keys)
        )


def test_check_tells_the_relative_density_and_takes_areas_from_an_expression(tmp_path):
    keys = {
        "kind": "cubic",
        "cells": [2, 2, 2],
        "pitch": 0.1,
        "bar_fields": {"thin": "1e-6 + z*1e-5"},
    }
    case = {
        "mesh": {"generator": "lattice", **keys},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {
            "s": {"area_field": "thin", "material": "m"},
            "e": {"area": 3e-6, "material": "m", "bars": "edges"},
        },
        "time": {"integrator": "central_differences", "step": "auto", "end": 1e-5},
    }
    resolved = Case.from_toml(Case.from_dict(case).to_toml())
    assert resolved.mesh == Case.from_dict(case).mesh
    simulation = Simulation(resolved, MPI.COMM_SELF, check_only=True)
    mesh = generated(fields=["thin"], **keys)
    area = mesh.bar_fields["thin"]
    area[mesh.bar_groups["edges"]] = 3e-6
    expected = (area * lengths(mesh)).sum() / 0.2**3
    assert float(simulation.summary()["relative density"].split()[0]) == pytest.approx(expected, rel=1e-3)
    case["section"]["s"]["area_field"] = "thick"
    with pytest.raises(InputError, match="section.s.area_field = 'thick': mesh.bar_fields has no such field"):
        Simulation(Case.from_dict(case), MPI.COMM_SELF, check_only=True)


@pytest.mark.parametrize(
    ("mesh", "text"),
    [
        ({"kind": "cell", "cell": {"points": [[0, 0, 0]]}}, "mesh.cell.struts: this key is missing (points that each"),
        ({"curved": {"shape": "cylinder", "radus": 1.0}}, "mesh.curved.radus: unknown key, did you mean 'radius'?"),
        ({"surface": {"scale": 1.0}}, "mesh.surface.file: this key is missing (STL, OBJ or PLY file"),
        ({"surface": {"file": "a.stl", "cut": "trimm"}}, 'mesh.surface.cut = "trimm": unknown value, did you mean'),
        ({"fields": {"rho": {"file": "a.vti"}}}, "mesh.fields.rho.array: this key is missing (name of an array"),
    ],
)
def test_problems_in_inner_tables_name_their_keys(mesh, text):
    case = {
        "mesh": {"generator": "lattice", "pitch": 1.0, "cells": [1, 1, 1], **mesh},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-6, "material": "m"}},
        "time": {"integrator": "central_differences", "step": "auto", "end": 1e-5},
    }
    with pytest.raises(InputError) as refused:
        Case.from_dict(case)
    assert text in str(refused.value)
