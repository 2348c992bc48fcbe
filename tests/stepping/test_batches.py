"""Batches of steps: the bits of single steps, which are batches of one, and the motion of the general stepper."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.lattices import planes, two_lattices
from helpers.triangles import ball
from mpi4py import MPI

from pfem_petsc import Case, Simulation, columns, open_result
from pfem_petsc.errors import EarlyStop, SimulationFailure
from pfem_petsc.mesh import ordering
from pfem_petsc.mesh.ordering import NODE_BLOCK

IT = {"young_modulus": 110e9, "density": 4500.0}
LATTICE = {
    "mesh": {"generator": "lattice", "kind": "cubic", "cells": [2, 2, 2], "pitch": 0.01},
    "node_set": {"foot": {"group": "bottom"}, "corner": {"nearest": [0.02, 0.02, 0.02]}},
    "material": {"it": IT},
    "section": {"it": {"area": 1e-6, "material": "it"}},
    "initial": {"velocity": [3.0, 1.0, -20.0]},
    "time": {"integrator": "central_differences", "step": 2e-7, "end": 8e-5},
    "output": {"fields_every": 150, "history_every": 7, "probe": [{"name": "feet", "node_set": "foot"}]},
}
PLASTIC = {"yield_stress": 100e6, "isotropic_hardening": 1e9, "kinematic_hardening": 2e9}
DAMPED = {"it": IT | {"damping": 2e4}}
FLOOR = {"name": "floor", "type": "plane", "point": [0, 0, -1e-5], "normal": [0.0, 0.1, 1.0]}
SIDE = {"name": "side", "type": "plane", "point": [0.0201, 0, 0], "normal": [-1.0, 0.0, 0.0], "node_set": "foot"}
BALL = {"name": "ball", "type": "sphere", "point": [0.008, 0.011, -0.02001], "radius": 0.02}
ROLLER = {
    "name": "roller",
    "type": "cylinder",
    "point": [0.011, 0.0, -0.03001],
    "axis": [0.1, 1.0, 0.0],
    "radius": 0.03,
}
SHELL = {"name": "shell", "type": "sphere", "point": [0.01, 0.01, 0.012], "radius": 0.0194, "side": "inside"}
SECTIONS = {
    "material": {"it": DAMPED["it"] | PLASTIC, "soft": {"young_modulus": 70e9, "density": 2700.0}},
    "section": {"it": {"area": 1e-6, "material": "it"}, "edges": {"area": 2e-6, "material": "soft", "bars": "edges"}},
    "wall": [FLOOR],
}
SMALL = {
    "sections": SECTIONS,
    "yielding": {"material": {"it": DAMPED["it"] | PLASTIC}, "wall": [FLOOR]},
    "flying": {},
    "held by feet": {"material": DAMPED, "support": [{"node_set": "foot", "fix": "xyz"}]},
    "walls": {"wall": [FLOOR, SIDE]},
    "held on an inclined wall": {
        "support": [{"node_set": "foot", "fix": "x"}],
        "wall": [FLOOR | {"normal": [0.5, 0.1, 1.0], "point": [0, 0, -2e-4]}],
    },
    "heavy": {"support": [{"node_set": "foot", "fix": "xz"}], "gravity": {"acceleration": [0.0, 0.0, -1e4]}},
    "loads over time": {
        "support": [{"node_set": "foot", "fix": "z"}],
        "load": [
            {"node_set": "corner", "force": [10.0, 0.0, 0.0]},
            {"node_set": "corner", "force": [0.0, 5.0, 0.0], "table": [[0.0, 0.0], [2e-5, 1.0], [5e-5, -2.0]]},
            {
                "node_set": "foot",
                "force": [0.0, 1.0, 0.0],
                "table": [[1e-5, 0.0], [3e-5, 1.0]],
                "interpolation": "smooth",
            },
        ],
        "gravity": {"acceleration": [0.0, 0.0, -1e4]},
    },
    "gravity over time": {
        "support": [{"node_set": "foot", "fix": "xz"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "gravity": {"acceleration": [[0.0, 0.0, 0.0, -1e4], [4e-5, 1e4, 0.0, 2e4]]},
        "wall": [SIDE],
    },
    "held and loaded": {
        "material": DAMPED,
        "support": [{"node_set": "foot", "fix": "z"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "wall": [SIDE],
    },
    "on springs": {"spring": [{"node_set": "foot", "stiffness": [1e5, 2e5, 3e5]}]},
    "carried by supports": {
        "material": DAMPED,
        "support": [
            {"node_set": "foot", "fix": "xz", "motion": [[0, 0, 0, 0], [3e-5, 1e-4, 0, -2e-4], [6e-5, 0, 0, 1e-4]]},
            {"node_set": "corner", "fix": "z"},
        ],
        "load": [{"node_set": "foot", "force": [0.0, 3.0, 2.0], "table": [[0.0, 0.0], [8e-5, 1.0]]}],
    },
    "carried along a wall": {
        "support": [
            {
                "node_set": "foot",
                "fix": "x",
                "motion": [[0, 0, 0, 0], [3.01e-5, 1e-4, 0, 0], [6e-5, 0, 0, 0]],
                "interpolation": "linear",
            }
        ],
        "spring": [{"node_set": "corner", "stiffness": [1e5, 2e5, 3e5]}],
        "wall": [FLOOR | {"normal": [0.5, 0.1, 1.0], "point": [0, 0, -2e-4]}],
    },
    "rough walls": {"wall": [FLOOR | {"friction": 0.3, "static_friction": 0.5}, SIDE | {"friction": 0.1}]},
    "rebounding": {"wall": [FLOOR | {"restitution": 0.6}, SIDE]},
    "rebounding, damped and rough": {
        "material": DAMPED,
        "wall": [FLOOR | {"restitution": 0.9}, SIDE | {"friction": 0.1}],
    },
    "pushed": {"wall": [FLOOR | {"velocity": [0.0, 0.0, 5.0], "restitution": 0.3}]},
    "pushed by rough walls": {
        "material": DAMPED,
        "support": [{"node_set": "corner", "fix": "z", "velocity": [0.0, 0.0, -20.0]}],
        "wall": [
            SIDE | {"velocity": [-2.0, 0.0, 0.0]},
            FLOOR
            | {"friction": 0.4, "motion": [[0, 0, 0, 0], [3.003e-5, 1e-4, 0, 2e-4], [6e-5, 0, 0, -1e-4]]}
            | {"interpolation": "linear"},
        ],
    },
    "on a ball beside a wall": {"wall": [BALL, SIDE | {"node_set": "foot"}]},
    "on a rough roller": {
        "material": DAMPED,
        "wall": [ROLLER | {"friction": 0.3, "static_friction": 0.4, "node_set": "foot"}, FLOOR],
    },
    "rebounding in a shell": {"wall": [SHELL | {"restitution": 0.7}]},
    "pushed by rough curved walls": {
        "support": [{"node_set": "corner", "fix": "z", "velocity": [0.0, 0.0, -20.0]}],
        "wall": [
            BALL | {"friction": 0.2, "velocity": [5.0, 0.0, 9.0], "restitution": 0.5},
            SHELL | {"friction": 0.1, "motion": [[0, 0, 0, 0], [3.003e-5, 1e-4, 0, 8e-4], [6e-5, 0, 0, 6e-4]]},
        ],
    },
    "breaking": {
        "material": {"it": DAMPED["it"] | {"rupture": {"strain": 3e-3, "steps": 3}}},
        "wall": [FLOOR | {"friction": 0.3}],
    },
    "removed": {
        "support": [{"name": "feet", "node_set": "foot", "fix": "z"}],
        "remove": [{"supports": "feet", "time": 3e-5}],
    },
    "removed in motion": {
        "material": DAMPED,
        "support": [{"name": "feet", "node_set": "foot", "fix": "xz", "velocity": [9.0, 0.0, -7.0]}],
        "remove": [{"supports": "feet", "time": 3.01e-5}],
        "wall": [FLOOR],
    },
    "removed in motion beside others": {
        "support": [
            {"name": "feet", "node_set": "foot", "fix": "z", "motion": [[0, 0, 0, 0], [3e-5, 0, 0, 1e-4]]},
            {"node_set": "corner", "fix": "y", "velocity": [0.0, 8.0, 0.0]},
        ],
        "remove": [{"supports": "feet", "time": 2e-5}],
    },
}


def block(*cells):
    return LATTICE["mesh"] | {"cells": list(cells)}


LARGE = {  # bars by padded runs
    "yielding block": {"mesh": block(12, 9, 10), "material": {"it": DAMPED["it"] | PLASTIC}, "wall": [FLOOR]},
    "block": {"mesh": block(9, 10, 11)},
    "sections of a block": SECTIONS
    | {
        "mesh": block(10, 11, 9) | {"bar_fields": {"area": "1e-6*(1 + 20*x)"}},
        "section": SECTIONS["section"] | {"it": {"area_field": "area", "material": "it"}},
        "load": [{"node_set": "corner", "force": [3e4, 3e3, 0.0]}],  # shortens some
    },
    "shortened bars": {  # by up to 17 %
        "mesh": block(9, 10, 11),
        "load": [{"node_set": "corner", "force": [1e5, 3e3, 0.0]}],
    },
    "missing bars": {"mesh": block(16, 17, 16) | {"missing": 0.02, "seed": 4}},
    "moving window": {"mesh": block(45, 12, 12)},
    "carried block": {
        "mesh": block(11, 9, 10),
        "support": [{"node_set": "foot", "fix": "xyz", "velocity": [3.0, 1.0, -20.0]}],
        "spring": [{"node_set": "corner", "stiffness": [1e5, 2e5, 3e5]}],
    },
    "held on a wall": {
        "mesh": block(11, 9, 10),
        "material": DAMPED,
        "support": [{"node_set": "foot", "fix": "x"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "wall": [FLOOR],
    },
    "viscoplastic": {
        "mesh": block(9, 10, 11),
        "material": {
            "it": IT
            | {"law": "cowper_symonds", "yield_stress": 50e6, "isotropic_hardening": 1e9}
            | {"rate_reference": 40.4, "rate_exponent": 5.0}
        },
        "support": [{"node_set": "foot", "fix": "z"}],
    },
    "viscous": {"mesh": block(10, 9, 11), "material": {"it": IT | {"stiffness_damping": 2e-8}}, "wall": [FLOOR]},
    "struts": {
        "mesh": block(9, 11, 10),
        "material": {"it": IT | {"law": "strut", "yield_stress": 1e6}},
        "section": {"it": {"area": 1e-6, "shape": "round", "material": "it"}},
        "support": [{"node_set": "foot", "fix": "z"}],
    },
    "own areas": {
        "mesh": block(10, 11, 9) | {"bar_fields": {"area": "1e-6*(1 + 20*x)"}},
        "section": {"it": {"area_field": "area", "material": "it"}},
        "support": [{"node_set": "foot", "fix": "z"}],
    },
}
PAIRS = {
    "free": {},
    "held, damped and heavy": {
        "supports": [{"node_set": "held", "fix": "x"}, {"node_set": "hinged", "fix": "xyz"}],
        "material": {"damping": 20.0},
        "gravity": (0.0, 0.0, -50.0),
    },
    "along an axis": {"direction": (1.0, 0.0, 0.0), "cells": (1, 3, 3)},
    "yielding": {"material": {"yield_stress": 1e4, "isotropic_hardening": 1e4, "kinematic_hardening": 1e4}},
    "many blocks": {"cells": (1, 14, 14), "end": 0.006},
}
WALLED = {  # with pairs: walls, and whether the nodes of pairs are in several
    "a moving wall beside pairs": (
        [{"type": "plane", "point": [0.206, 0, 0], "normal": [-1.0, 0.1, 0.0], "node_set": "end"}],
        False,
    ),
    "pairs on a floor": (planes([[0.0, 0.0, 1.0]], [-0.001]), False),
    "pairs in a moving wedge": (
        planes([[0.0, 0.3, 1.0], [0.1, 1.0, -0.2]], [-0.002, -0.04]),
        False,
    ),
    "pairs that share nodes": ([], True),
    "pairs that share nodes on a floor": (planes([[0.1, -0.4, 1.0]], [-0.076]), True),
}
COMPILED_HERE = ("viscoplastic", "viscous", "struts")  # their loops take 15 s each to compile
NAMES = [
    *SMALL,
    *(pytest.param(name, marks=pytest.mark.thorough if name in COMPILED_HERE else ()) for name in LARGE),
]
ARRAYS = ("x", "v", "a", "f", "contact", "support")


def case(changes, **time):
    return Case.from_dict(LATTICE | changes | {"time": LATTICE["time"] | time})


def made(case, folder, how, comm=None):
    """Run a case in ``batches``, by ``single`` steps, or by the ``general`` stepper, as functions of loads need it."""
    simulation = Simulation(case, comm, output=folder / how, quiet=True)
    if how == "general":
        simulation.external_force(lambda time, state: np.zeros((len(simulation.state.v), 3)))
    steps = list(simulation.batches() if how == "batches" else simulation)
    return simulation, len(steps)


def compare(one, other, exact=True, same_order=True):
    """Compare the states and the histories of two runs; return the history. The sums of forces at nodes have the
    ``same_order``, and therefore the same bits, unless one run goes through the bars of several sections one section
    after the other, and the other one block of nodes after the other."""
    for what in ARRAYS:
        ours, others = getattr(one.state, what), getattr(other.state, what)
        rounding = 0.0 if exact and same_order else 1e-9 * np.abs(ours).max(initial=0.0)
        np.testing.assert_allclose(ours, others, rtol=0.0, atol=rounding, err_msg=what)
    first, second = (open_result(simulation.folder).history for simulation in (one, other))
    compare_histories(first, second, exact)
    return first


def compare_histories(first, second, exact=True):
    """As :func:`compare`."""
    assert sorted(first) == sorted(second)
    scale = max(np.abs(first[column]).max() for column in first if column.endswith(("energy", "work")))
    for column in first:
        if exact:
            np.testing.assert_array_equal(first[column], second[column], err_msg=column)
        elif column.endswith(("energy", "work", "dissipation", "imbalance")):
            np.testing.assert_allclose(first[column], second[column], atol=1e-11 * scale, err_msg=column)
        else:
            rounding = 1e-9 * np.abs(first[column]).max(initial=0.0) + 1e-15  # second differences of positions
            np.testing.assert_allclose(first[column], second[column], rtol=1e-9, atol=rounding, err_msg=column)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", NAMES)
def test_batches_are_single_steps_and_move_as_the_general_stepper(name, comm, shared_tmp_path):
    given = case(SMALL[name]) if name in SMALL else case(LARGE[name], end=2.2e-5)
    one, count = made(given, shared_tmp_path, "single")
    many, fewer = made(given, shared_tmp_path, "batches")
    assert count == round(given.time.end / given.time.step) and fewer < count / 4
    history = compare(one, many)
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()
    for first, second in zip(one.model.bars.blocks, many.model.bars.blocks, strict=True):
        np.testing.assert_array_equal(first.history, second.history)
    # a support that is removed gives its reaction to another list of loads
    if name in SMALL and not name.startswith("removed"):
        general = made(given, shared_tmp_path, "general")[0]
        moves = any(word in name for word in ("carried", "pushed", "rebounding"))  # rounding of times
        compare(one, general, exact=False, same_order=name != "sections" and not moves)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", PAIRS)
def test_batches_with_pairs(name, comm, shared_tmp_path, monkeypatch):
    monkeypatch.setattr(ordering, "_by_graph", lambda slab, comm: None)  # PT-Scotch divides a mesh anew in each run
    tables = two_lattices(shared_tmp_path / "mesh.vtu", "central_differences", **PAIRS[name])
    tables["output"] = {"fields_every": 0, "history_every": 3, "probe": [{"name": "held", "node_set": "held"}]}
    given = Case.from_dict(tables)
    one, count = made(given, shared_tmp_path, "single", comm)
    many, fewer = made(given, shared_tmp_path, "batches", comm)
    assert fewer < 0.4 * count
    assert name != "many blocks" or comm.size > 1 or len(one.state.v) > 2 * NODE_BLOCK
    other = made(given, shared_tmp_path, "general", comm)[0]
    history = open_result(many.folder).history
    compare(one, many)
    np.testing.assert_array_equal(one.model.links.force, many.model.links.force)
    assert history["active_contacts"].max() > 8 and np.ptp(history["active_contacts"]) > 8
    assert np.abs(history["pair/faces/impulse"][-1]).max() > 0.01 and history["impact_dissipation"][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()
    compare(one, other, exact=False)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("supported", [False, True], ids=["free", "supported"])
@pytest.mark.parametrize("name", WALLED)
def test_batches_with_pairs_and_walls(name, supported, comm, shared_tmp_path, monkeypatch):
    monkeypatch.setattr(ordering, "_by_graph", lambda slab, comm: None)
    supports = [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xz"}] if supported else []
    tables = two_lattices(shared_tmp_path / "mesh.vtu", "central_differences", supports=supports)
    walls, crowded = WALLED[name]
    tables["node_set"]["end"] = {"box": [[0.19, -1.0, -1.0], [1.0, 1.0, 1.0]]}
    if walls:
        tables["wall"] = [wall | ({"velocity": [-1.0, 0.1, 0.3]} if "moving" in name else {}) for wall in walls]
    if crowded:
        tables["contact_pair"].append(tables["contact_pair"][0] | {"name": "across", "direction": [1.0, -0.4, 0.3]})
    tables["output"] = {"fields_every": 0, "history_every": 3}
    given = Case.from_dict(tables)
    one, count = made(given, shared_tmp_path, "single", comm)
    many, fewer = made(given, shared_tmp_path, "batches", comm)
    assert fewer < 0.4 * count
    other = made(given, shared_tmp_path, "general", comm)[0]
    history = compare(one, many)
    np.testing.assert_array_equal(one.model.links.force, many.model.links.force)
    np.testing.assert_array_equal(one.stepper.touching, many.stepper.touching)
    for k in range(1, len(walls) + 1):
        assert np.abs(history[f"wall/wall{k}/impulse"][-1]).max() > 1e-3
    assert np.abs(history["pair/faces/impulse"][-1]).max() > 0.01 and history["impact_dissipation"][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()
    compare(one, other, exact=False, same_order="moving" not in name)  # rounding of times


TURNING = {"rotation": {"centre": [0.0, 0.01, 0.0], "axis": [0.2, 1.0, 0.0], "angular_velocity": 90.0}}
ROCKS = {"type": "surface", "name": "rock", "file": "rock.obj", "scale": 0.011}
ROCK = ROCKS | {"point": [0.009, 0.011, -0.0111]}
CALLED = {
    "a plane that turns": {"wall": [FLOOR | TURNING]},
    "a rough roller that turns beside a wall": {
        "wall": [
            ROLLER | {"friction": 0.3, "rotation": TURNING["rotation"] | {"axis": [0.1, 1.0, 0.0]}, "node_set": "foot"},
            SIDE | {"velocity": [-2.0, 0.0, 0.0]},
        ],
    },
    "a plane that rocks, lifts and rebounds": {
        "material": DAMPED,
        "wall": [
            FLOOR
            | {"restitution": 0.6, "motion": [[0, 0, 0, 0], [3e-5, 1e-4, 0, 8e-4], [6e-5, 0, 0, 6e-4]]}
            | {"rotation": TURNING["rotation"] | {"angles": [[0.0, 0.0], [4e-5, 0.01], [8e-5, -0.01]]}}
        ],
    },
    "a rock": {"wall": [ROCK]},
    "a rough rock that moves beside walls": {
        "material": DAMPED,
        "wall": [ROCK | {"friction": 0.2, "velocity": [3.0, 0.0, 5.0]}, FLOOR | {"point": [0, 0, -3e-4]}, SIDE],
    },
    "a rock that turns and rebounds": {
        "wall": [ROCK | TURNING | {"restitution": 0.5}, ROCK | {"name": "other", "point": [0.0, 0.0, -0.0112]}],
    },
}
del CALLED["a plane that rocks, lifts and rebounds"]["wall"][0]["rotation"]["angular_velocity"]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", CALLED)
def test_batches_with_walls_that_turn_and_surfaces_of_triangles(name, comm, shared_tmp_path):
    if comm.rank == 0:
        points, corners = ball(2)
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
        lines += ["f " + " ".join(map(str, own)) for own in (corners + 1).tolist()]
        (shared_tmp_path / "rock.obj").write_text("\n".join(lines))
    comm.barrier()
    tables = {name: value for name, value in CALLED[name].items() if name != "wall"}
    walls = [
        wall | ({"file": str(shared_tmp_path / "rock.obj")} if "file" in wall else {}) for wall in CALLED[name]["wall"]
    ]
    given = case(tables | {"wall": walls})
    one, count = made(given, shared_tmp_path, "single", comm)
    many, fewer = made(given, shared_tmp_path, "batches", comm)
    assert count == round(given.time.end / given.time.step) and fewer < count / 4
    history = compare(one, many)
    np.testing.assert_array_equal(one.stepper.touching, many.stepper.touching)
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"].max()
    for wall in walls:
        assert np.abs(history[f"wall/{wall['name']}/impulse"][-1]).max() > 1e-3
    moves = any("velocity" in wall or "rotation" in wall for wall in walls)
    assert (np.abs(history["contact_work"]).max() > 1e-6 * history["kinetic_energy"].max()) == moves
    assert history["impact_dissipation"][-1] > 0.0 and history["active_contacts"].max() > 0
    other = made(given, shared_tmp_path, "general", comm)[0]
    compare(one, other, exact=False, same_order=False)


MOVED = {"restitution": 0.3, "friction": 0.2, "motion": [[0, 0, 0, 0], [8e-6, 0, 0, 1e-4], [3e-5, 1e-4, 0, -1e-4]]}
CROWDED = SECTIONS | {  # something of each kind
    "node_set": LATTICE["node_set"] | {"edge": {"group": "right"}, "side": {"nearest": [0.0, 0.0, 0.02]}},
    "material": SECTIONS["material"]
    | {"soft": {"young_modulus": 70e9, "density": 2700.0, "rupture": {"strain": 2e-3}}},
    "support": [{"node_set": "corner", "fix": "yz", "velocity": [0.0, 9.0, -7.0]}],
    "load": [{"node_set": "foot", "force": [0.0, 3.0, 2.0], "table": [[0.0, 0.0], [2e-5, 5.0]]}],
    "gravity": {"acceleration": [0.0, 0.0, -1e4]},
    "spring": [{"node_set": "edge", "stiffness": [1e5, 2e5, 3e5]}],
    "dashpot": [{"node_set": "side", "coefficient": 3.0}],
    "wall": [FLOOR | MOVED, SIDE | {"point": [0.02002, 0, 0]}],
    "output": {"fields_every": 0, "history_every": 1, "probe": [{"name": "all", "node_set": "every"}]},
}
CROWDED["node_set"]["every"] = {"all": True}


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("declared", [False, True], ids=["own", "declared"])
def test_all_columns_of_all_steps_are_those_of_single_steps(declared, comm, shared_tmp_path, monkeypatch):
    """By any driver on any number of ranks, also an energy and a vector with a ``value`` that no loop has: in the room
    of columns that the case leaves empty, for which the loops need not be compiled again."""
    if declared:
        sideways = columns.energy("wall_kinetic_energy", "part", "state", value=sideways_energy)
        monkeypatch.setattr(columns, "ENERGIES", (*columns.ENERGIES, sideways))
        drift = columns.Column("damping_impulse", "kg m/s", 3, value=lambda now: now.model.inertia.mass @ now.state.v)
        monkeypatch.setattr(columns, "VECTORS", (*columns.VECTORS, drift))
    given = case(CROWDED, end=1.6e-5)
    one, count = made(given, shared_tmp_path, "single", comm)
    many, fewer = made(given, shared_tmp_path, "batches", comm)
    assert count == 80 and (fewer == count if declared else fewer < count / 3)
    history = compare(one, many)
    others = [] if declared else [made(given, shared_tmp_path, "general", comm)[0]]
    if comm.size > 1:
        others.append(made(given, shared_tmp_path / f"alone{comm.rank}", "batches", MPI.COMM_SELF)[0])
    for other in others:
        compare_histories(history, open_result(other.folder).history, exact=False)
    empty = {"step_size", "newton_iterations", "linear_iterations", "damage_dissipation", "viscous_dissipation"}
    empty |= {"thermal_work", "prestress_work", "wall/floor/jump_impulse", "wall/side/jump_impulse"}
    empty |= {"self_contact_energy", "self_contact_dissipation"}
    constant = {name for name in history if np.ptp(history[name]) == 0.0}
    assert constant <= empty | ({"wall_kinetic_energy"} if not declared else set())
    # node by node what supports, walls, springs and dashpots do
    reactions, places = history["probe/all/reaction"], history["probe/all/position"][0]
    side = np.argmin(np.abs(places - [0.0, 0.0, 0.02]).sum(axis=1))
    drag = 3.0 * history["probe/all/velocity"][:, side]
    total = history["support_force"] + history["wall/floor/force"] + history["wall/side/force"] - drag
    np.testing.assert_allclose(reactions.sum(axis=1), total, atol=1e-12 * np.abs(reactions).sum(axis=1).max())
    assert np.abs(drag).max() > 1.0
    if declared:
        probed, mass = history["probe/all/velocity"], one.gather(one.model.inertia.mass)
        mass = comm.bcast(mass)
        np.testing.assert_allclose(history["damping_impulse"], np.einsum("n,tnc->tc", mass, probed), rtol=1e-12)
        exact = 0.5 * probed[:, :, 1] ** 2 @ mass
        np.testing.assert_allclose(history["wall_kinetic_energy"], exact, rtol=1e-12)


def sideways_energy(now):
    return 0.5 * now.model.inertia.mass @ now.state.v[:, 1] ** 2


@pytest.mark.parametrize("what", ["chung_lee", "newmark"])
def test_what_batches_do_not_serve_takes_single_steps(what, tmp_path):
    tables = two_lattices(tmp_path / "mesh.vtu", "central_differences", end=0.004)
    del tables["contact_pair"]
    tables["time"] |= {"integrator": what}
    tables["output"] = {"fields_every": 0, "history_every": 10}
    _, count = made(Case.from_dict(tables), tmp_path, "batches", MPI.COMM_SELF)
    assert count == 20


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [False, True])
def test_a_stopped_run_of_batches_goes_on_to_the_same_end(pairs, tmp_path):
    given = case(SMALL["yielding"])
    if pairs:
        given = Case.from_dict(two_lattices(tmp_path / "mesh.vtu", "central_differences"))
        given.output.history_every, given.output.fields_every = 7, 20
    whole, _ = made(given, tmp_path / "whole", "batches", MPI.COMM_SELF)
    stopped = Simulation(given, MPI.COMM_SELF, output=tmp_path / "part", quiet=True)
    with pytest.raises(EarlyStop):
        for step in stopped.batches():
            if step.step > 40:
                stopped._synchroniser.stop._signal = 15
    assert 40 < stopped.state.step < whole.state.step
    rest = Simulation(given, MPI.COMM_SELF, output=tmp_path / "part", restart=True, quiet=True)
    for _ in rest.batches():
        pass
    compare(whole, rest)


CRUSHED = {"initial": {"velocity": [0.0, 0.0, -2e4]}, "wall": [FLOOR]}


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", ["on a wall", "by a load"])
def test_a_failure_is_that_of_single_steps(name, shared_tmp_path):
    """Also of bars by padded runs, where those between the rows of the lattice do not count."""
    load = {"node_set": "corner", "force": [1e7, 1e5, 0.0]}
    given = case({"on a wall": CRUSHED, "by a load": {"mesh": block(9, 10, 11), "load": [load]}}[name])
    texts, steps = [], []
    for how in ("single", "batches", "general"):
        with pytest.raises(SimulationFailure) as failure:
            made(given, shared_tmp_path, how)
        texts.append(str(failure.value))
        steps.append(open_result(shared_tmp_path / how).history["step"])
    assert "bar" in texts[0] and texts[0] == texts[1] == texts[2]
    np.testing.assert_array_equal(steps[0], steps[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["turning", "squeezed", "jammed"])
def test_a_failure_at_curved_walls_is_that_of_single_steps(name, shared_tmp_path):
    """A ball presses nodes against a floor, and against supports."""
    ball = BALL | {"node_set": "foot", "point": [0.01, 0.01, 0.0202], "velocity": [0.0, 0.0, -10.0]}
    floor = FLOOR | {"normal": [0.0, 0.0, 1.0]}
    changes, text = {
        "turning": ({"wall": [ball, floor]}, "on curved walls did not converge"),
        "squeezed": ({"wall": [ball, floor], "support": [{"node_set": "foot", "fix": "xy"}]}, "no position of node"),
        "jammed": (
            {
                "wall": [ball | {"friction": 0.5, "point": [0.01, 0.014, 0.0202]}],
                "support": [{"node_set": "foot", "fix": "xz"}],
            },
            "friction jams node",
        ),
    }[name]
    given, texts, steps = case(changes | {"output": {"fields_every": 0, "history_every": 7}}), [], []
    for how in ("single", "batches", "general"):
        with pytest.raises(SimulationFailure) as failure:
            made(given, shared_tmp_path, how)
        texts.append(str(failure.value))
        steps.append(open_result(shared_tmp_path / how).history["step"])
    assert text in texts[0] and texts[0] == texts[1] == texts[2]
    np.testing.assert_array_equal(steps[0], steps[1])


JAMMED = {  # a wall pushes the end of a rod against a node that is held
    "mesh": {"generator": "two_rods", "length": 1.0, "elements": 5, "gap": 0.001},
    "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
    "section": {"it": {"area": 1e-4, "material": "it"}},
    "node_set": {name: {"group": name} for name in ("first_end", "second_start")},
    "support": [{"node_set": "second_start", "fix": "xyz"}],
    "contact_pair": [{"name": "faces", "first": "first_end", "second": "second_start", "direction": [1.0, 0.0, 0.0]}],
    "wall": [
        {
            "type": "plane",
            "node_set": "first_end",
            "point": [0.9999, 0, 0],
            "normal": [1, 0, 0],
            "velocity": [0.1, 0, 0],
        }
    ],
    "time": {"integrator": "central_differences", "step": 1e-4, "end": 0.03},
    "output": {"fields_every": 0, "history_every": 7},
}


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 7])
def test_rows_without_solution_fail_as_in_single_steps(every, comm, shared_tmp_path):
    given, texts = Case.from_dict(JAMMED | {"output": {"fields_every": 0, "history_every": every}}), []
    for how in ("single", "batches", "general"):
        with pytest.raises(
            SimulationFailure, match="no positions of nodes 5, 6 satisfy their contact pairs"
        ) as failure:
            made(given, shared_tmp_path, how, comm)
        texts.append(str(failure.value))
    assert texts[0] == texts[1] == texts[2]


@pytest.mark.parallel
@pytest.mark.parametrize("every", [1, 1000])
def test_the_first_failure_is_reported(every, shared_tmp_path):
    """A bar fails on one rank; before the ranks synchronise, more fail on others as a consequence."""
    output = {"history_every": every, "fields_every": 0}
    for how in ("single", "batches"):
        with pytest.raises(SimulationFailure, match=r"step 140, .* nodes 32 and 33 "):
            made(case(CRUSHED | {"mesh": block(2, 4, 3), "output": output}), shared_tmp_path, how)
