"""Gravity over time: base excitation as a body force in the frame of the ground, against supports that move."""

import numpy as np
import pytest
from helpers.kills import differences
from helpers.oscillator import TIMES, ground, modal_response
from helpers.runs import run
from helpers.stopped import everywhere
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.stepping.model import Model

STEP = 1e-3
SCHEMES = {
    "trapezoid": ("newmark", {"beta": 0.25, "gamma": 0.5}),
    "newmark": ("newmark", {}),
    "wilson": ("wilson", {}),
    **{
        name: (name, {})
        for name in ("energy_momentum", "generalized_alpha", "houbolt", "central_differences", "chung_lee")
    },
    "hulbert_chung": ("hulbert_chung", {}),
    "souza_moura": ("souza_moura", {}),
}
EA = 40.0
VALUES = 1e-3 * ground(TIMES)[2]  # so small that the dome stays linear
RECORD = [[float(t), float(x), 0.0, 0.0] for t, x in zip(TIMES, VALUES)]


def dome(scheme, **tables):
    integrator, parameters = SCHEMES[scheme]
    return Case.from_dict(
        {
            "mesh": {
                "generator": "star_dome",
                "apex_height": 3.0,
                "ring_height": 2.0,
                "ring_radius": 2.0,
                "base_radius": 3.0,
            },
            "node_set": {"feet": {"group": "feet"}, "all": {"all": True}},
            "material": {"m": {"young_modulus": 100.0 * EA, "density": 10.0}},
            "section": {"s": {"area": 0.01, "material": "m"}},
            "support": [{"node_set": "feet", "fix": "xyz"}],
            "time": {"integrator": integrator, "step": STEP, "end": 0.4, **parameters},
            "output": {"fields_every": 0, "history_every": 4, "probe": [{"name": "all", "node_set": "all"}]},
            "solver": {"rtol": 1e-11, "linear": "cg"},
            **tables,
        }
    )


def shaken(scheme, frame, **tables):
    if frame == "absolute":
        return dome(scheme, support=[{"node_set": "feet", "fix": "xyz", "acceleration": RECORD}], **tables)
    return dome(scheme, gravity={"acceleration": [[t, -x, y, z] for t, x, y, z in RECORD]}, **tables)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_relative_frame_is_absolute_frame_less_the_ground(scheme, tmp_path):
    """A dome under a record of 20 ms rows at steps of 1 ms: both frames, and the exact response of its modes."""
    absolute = run(shaken(scheme, "absolute"), tmp_path / "a", MPI.COMM_SELF)
    relative = run(shaken(scheme, "relative"), tmp_path / "r", MPI.COMM_SELF)
    model = Model(dome(scheme), MPI.COMM_SELF)
    exact, lowest = modal_response(model, EA, TIMES, VALUES, relative["time"])
    order = np.argsort(model.mesh.node_ids)  # probes are in the order of the mesh
    exact, feet = exact[:, order], np.sort(model.mesh.node_ids[model.nodes["feet"]])
    peak = np.abs(exact).max()
    moved = [history["probe/all/position"] - history["probe/all/position"][0] for history in (absolute, relative)]
    moved[0] = moved[0] - moved[0][:, feet[:1]]
    # schemes of first order have their own error
    most = {"newmark": 0.05, "souza_moura": 0.05}.get(scheme, 1e-3)
    assert np.abs(moved[0] - moved[1]).max() <= most * peak
    for each in moved:
        assert np.abs(each - exact).max() <= most * peak
    # floor accelerations: the record at the feet; at all other nodes, in both frames alike
    floors = absolute["probe/all/acceleration"]
    record = np.interp(absolute["time"], TIMES, VALUES)
    np.testing.assert_allclose(floors[:, feet[0], 0], record, atol=1e-9 * np.abs(VALUES).max())
    other = relative["probe/all/acceleration"] + record[:, None, None] * [1.0, 0.0, 0.0]
    if scheme not in ("newmark", "souza_moura"):
        assert np.abs(floors - other)[3:].max() < 5e-3 * np.abs(floors).max()
    for history in (absolute, relative):
        assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["absolute", "relative"])
@pytest.mark.parametrize("scheme", ["trapezoid", "central_differences"])
def test_reactions_are_mass_times_acceleration(scheme, frame, comm, shared_tmp_path):
    history = run(shaken(scheme, frame), shared_tmp_path, comm)
    model = Model(dome(scheme), MPI.COMM_SELF)
    mass = model.inertia.mass[np.argsort(model.mesh.node_ids)]
    inertia = np.einsum("n,tni->ti", mass, history["probe/all/acceleration"])
    record = np.interp(history["time"], TIMES, VALUES)[:, None] * [1.0, 0.0, 0.0]
    if frame == "relative":
        inertia = inertia + model.total_mass * record
    np.testing.assert_allclose(history["support_force"], inertia, atol=2e-9 * np.abs(inertia).max())


@pytest.mark.slow
def test_free_fall_under_a_table(comm, shared_tmp_path):
    """The velocity is the integral of the table, which is constant outside its rows; smooth ones of their spline."""
    for smooth, integral in ((False, 0.5 * 2.0 + 0.5 * 4.0), (True, 0.5 * 2.0 + 0.5 * 4.0)):
        gravity = {"acceleration": [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, -4.0]]}
        gravity |= {"interpolation": "smooth"} if smooth else {}
        case = dome(
            "trapezoid",
            support=[],
            gravity=gravity,
            time={"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 0.01, "end": 1.0},
        )
        history = run(case, shared_tmp_path / str(smooth), comm)
        assert history["momentum"][-1, 2] == pytest.approx(-integral * Model(case, MPI.COMM_SELF).total_mass, rel=1e-10)
        assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "generalized_alpha"])
def test_restart_is_bitwise_and_notices_a_changed_record(scheme, comm, shared_tmp_path):
    def shake(folder, end, factor=1.0, **options):
        path = shared_tmp_path / "record.csv"
        if comm.rank == 0:
            path.write_text("\n".join(f"{t}, {factor * x}, 0, 0" for t, x, _, _ in RECORD))
        comm.barrier()
        gravity = {"acceleration": [0.0, 0.0, -1e-3], "acceleration_file": str(path)}
        time = {"integrator": scheme, "step": STEP, "end": end}
        case = dome(scheme, gravity=gravity, time=time, output={"checkpoint_every": 10})
        with Simulation(case, comm, output=shared_tmp_path / folder, quiet=True, **options) as simulation:
            return simulation.run()

    shake("whole", 0.05)
    shake("parts", 0.03)
    with pytest.raises(InputError, match=r"belongs to a different case .*gravity.acceleration"):
        shake("parts", 0.05, factor=2.0, restart=True)
    shake("parts", 0.05, restart=True)
    folders = (shared_tmp_path / name / "result.vtkhdf" for name in ("whole", "parts"))
    assert everywhere(comm, differences, *folders) == {}


def test_walls_with_weight_need_constant_gravity(tmp_path):
    wall = {"name": "lid", "type": "plane", "point": [0, 0, 9.0], "normal": [0, 0, -1.0], "mass": 1.0, "gravity": True}
    with pytest.raises(InputError, match="walls with gravity = true need a constant gravity"):
        Simulation(shaken("trapezoid", "relative", wall=[wall]), MPI.COMM_SELF, output=tmp_path / "out", quiet=True)
