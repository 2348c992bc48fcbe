"""Areas of bars from a cell field of the mesh: the same results as a section for each bar, and refusals."""

import numpy as np
import pytest
from helpers.runs import run

from pfem_petsc import Case, Simulation, open_result, write_mesh
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice

YOUNG, DENSITY = 2e9, 1000.0


def octet():
    """Points, bars and areas of a graded cell; the areas have no order."""
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=(1, 1, 1), pitch=0.1), 0, 1)
    bars = np.asarray(slab.bars, dtype=np.int64)
    return slab.points, bars, 1e-6 * (1.0 + (7 * np.arange(len(bars)) % len(bars)) / len(bars))


def written(folder, comm, **more):
    """The mesh with the field ``thickness``, and with a group for each bar."""
    points, bars, areas = octet()
    groups = {f"bar{k}": [k] for k in range(len(bars))}
    return write_mesh(
        folder / "graded.h5", points, bars, bar_groups=groups, bar_fields={"thickness": areas, **more}, comm=comm
    )


def graded(file, section, material=(), **tables):
    """A cell held at three nodes that starts to move."""
    data = {
        "mesh": {"file": str(file)},
        "node_set": {"foot": {"box": [[-1.0, -1.0, -1e-3], [1.0, 1.0, 1e-3]]}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY, "damping": 1e4, **dict(material)}},
        "section": section,
        "support": [{"node_set": "foot", "fix": "xyz"}],
        "initial": {"velocity": [3.0, 1.0, -20.0]},
        "gravity": {"acceleration": [0.0, 0.0, -1e3]},
        "time": {"integrator": "newmark", "step": 2e-6, "end": 4e-5},
        "output": {"fields_every": 0},
    } | tables
    return Case.from_dict(data)


PLASTIC = {"yield_stress": 4e6, "isotropic_hardening": 1e8}
RUNS = {
    "explicit": ({"integrator": "central_differences"}, {}, {}),
    "implicit": ({}, PLASTIC, {}),
    "consistent": ({"mass": "consistent"}, {}, {}),
    "matrix-free": ({"mass": "consistent"}, {}, {"solver": {"operator": "matrix_free", "linear": "cg", "rtol": 1e-12}}),
    "energy_momentum": ({"integrator": "energy_momentum", "mass": "consistent"}, {"strain": "green"}, {}),
    "yielding": ({"integrator": "central_differences"}, PLASTIC, {}),
}


@pytest.mark.parallel
@pytest.mark.parametrize("name", RUNS)
def test_field_is_a_section_for_each_bar(name, shared_tmp_path, comm):
    time, material, tables = RUNS[name]
    tables |= {"time": {"integrator": "newmark", "step": 2e-6, "end": 4e-5, **time}}
    file = written(shared_tmp_path, comm)
    one = {"s": {"area_field": "thickness", "material": "m"}}
    each = {f"s{k}": {"area": a, "material": "m", "bars": f"bar{k}"} for k, a in enumerate(octet()[2].tolist())}
    histories = [
        run(graded(file, section, material, **tables), shared_tmp_path / f"{k}")
        for k, section in enumerate((one, each))
    ]
    assert histories[0]["elastic_energy"][-1] > 0.01 * histories[0]["kinetic_energy"][0]
    for column in ("kinetic_energy", "elastic_energy", "plastic_dissipation", "momentum", "support_force"):
        scale = np.abs(histories[1][column]).max()
        np.testing.assert_allclose(*(h[column] for h in histories), rtol=1e-9, atol=1e-9 * scale, err_msg=column)


@pytest.mark.parallel
def test_pretension_of_bars_with_areas_of_their_own(shared_tmp_path, comm):
    """The force is the same in all bars, the stress is not."""
    section = {"s": {"area_field": "thickness", "material": "m", "pretension": 50.0}}
    run(graded(written(shared_tmp_path, comm), section), shared_tmp_path / "out")
    if comm.rank == 0:
        result = open_result(shared_tmp_path / "out")
        np.testing.assert_allclose(result.field("axial_force", 0), 50.0, rtol=1e-10)
        np.testing.assert_allclose(result.field("stress", 0), 50.0 / octet()[2], rtol=1e-10)


@pytest.mark.parallel
@pytest.mark.parametrize("wrong", [0.0, -1e-6, np.nan])
def test_areas_that_are_not_positive(wrong, shared_tmp_path, comm):
    areas = octet()[2]
    areas[11] = wrong
    file = written(shared_tmp_path, comm, broken=areas)
    with pytest.raises(InputError, match=r"section.s.area_field = 'broken': bar 11 of .*graded.h5 \(and 0 more here\)"):
        Simulation(
            graded(file, {"s": {"area_field": "broken", "material": "m"}}),
            comm,
            output=shared_tmp_path / "o",
            quiet=True,
        )


def test_areas_too_small_for_a_tube(tmp_path):
    from mpi4py import MPI

    file = written(tmp_path, MPI.COMM_SELF)
    section = {"area_field": "thickness", "material": "m", "shape": "tube", "thickness": 6e-4}
    with pytest.raises(
        InputError, match=r"thickness = 0.0006 m is too much for the tube of bar 0, whose area is 1e-06"
    ):
        Simulation(graded(file, {"s": section}), output=tmp_path / "o", quiet=True)


@pytest.mark.parametrize(
    ("section", "mesh", "text"),
    [
        (
            {"area_field": "a", "area": 1.0},
            {"generator": "rod", "length": 1.0, "elements": 1},
            "at most one of the keys area, area_field",
        ),
        ({}, {"generator": "rod", "length": 1.0, "elements": 1}, "expected area, area_field, or a shape"),
        (
            {"area_field": "a"},
            {"generator": "rod", "length": 1.0, "elements": 1},
            "generator rod has no cell fields",
        ),
        ({"area_field": "a"}, {"file": "ring.msh"}, "no field of this name"),
    ],
)
def test_refused(section, mesh, text, tmp_path):
    from pathlib import Path

    data = {
        "mesh": {k: str(Path(__file__).parents[2] / "meshes" / v) if k == "file" else v for k, v in mesh.items()},
        "material": {"m": {"young_modulus": 1e9, "density": 1e3}},
        "section": {"s": {"material": "m", **section}},
        "time": {"integrator": "newmark", "step": 1e-3, "end": 1e-2},
    }
    with pytest.raises(InputError, match="section.s") as error:
        Simulation(Case.from_dict(data), output=tmp_path / "out", quiet=True)
    assert text in str(error.value)
