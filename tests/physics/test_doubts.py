"""Bars beyond Euler's load or beyond the range of the law are told once, and counted at the end of the run."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss

RADIUS, LENGTH, YOUNG = 0.01, 2.0, 2e11
EULER = np.pi**3 * YOUNG * RADIUS**4 / 4.0 / LENGTH**2


def columns(material, analysis, force, **tables):
    """Two vertical bars with round sections: the second carries half of the load of the first."""
    points = [[0.0, 0, 0], [0, 0, LENGTH], [1, 0, 0], [1, 0, LENGTH]]
    heads = [{"node_set": name, "force": [0.0, 0.0, -each]} for name, each in (("one", force), ("two", 0.5 * force))]
    return Case(
        {
            "node_set": {name: {"indices": list(i)} for name, i in (("feet", [0, 2]), ("one", [1]), ("two", [3]))}
            | {"heads": {"indices": [1, 3]}},
            "material": {"it": {"young_modulus": YOUNG, "density": 7800.0, **material}},
            "section": {"it": {"area": np.pi * RADIUS**2, "shape": "round", "material": "it"}},
            "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "heads", "fix": "xy"}],
            "load": heads,
            "output": {"fields_every": 1, "checkpoint_every": 1},
            **analysis,
            **tables,
        },
        mesh=Truss(points, [[0, 1], [2, 3]]),
    )


def run(case, comm, folder, capfd, **how):
    """Return the messages on stderr, and the log."""
    assert Simulation(case, comm, output=folder, quiet=True, **how).run() == 0
    error = comm.bcast(capfd.readouterr().err)
    return error, comm.bcast((folder / "log.txt").read_text() if comm.rank == 0 else None)


STATIC = {"static": {"method": "newton", "step": 0.25, "min_step": 0.25, "max_step": 0.25, "end": 1.0}}


@pytest.mark.parallel
@pytest.mark.parametrize("law", ["elastic", "elastoplastic"])
def test_static_loads_beyond_eulers_load(law, comm, shared_tmp_path, capfd):
    material = {"law": law} if law == "elastic" else {"law": law, "yield_stress": 1e9, "isotropic_hardening": 0.0}
    error, log = run(columns(material, STATIC, 2.4 * EULER), comm, shared_tmp_path / "it", capfd)
    # 0.6, 1.2, 1.8, 2.4 in the first bar; half of that in the second
    assert error.count("Euler's load") == 1  # at the first; at the end it is counted
    assert (
        "step 2, load factor 0.5: 1 bar is compressed beyond Euler's load, most of all bar 0 with 120 % of it" in error
    )
    told = "compressed beyond Euler's load in 3 of 5 snapshots, first at step 2, load factor 0.5: up to 2 at once, most"
    assert log.count(told + " of all bar 0 with 240 % of it, at step 4, load factor 1") == 1


@pytest.mark.parametrize("law", ["cable", "strut"])
def test_laws_that_buckle_are_not_compared(law, comm, shared_tmp_path, capfd):
    load = 0.9 * EULER if law == "strut" else -3.0 * EULER
    error, log = run(columns({"law": law, "yield_stress": 1e9}, STATIC, load), comm, shared_tmp_path / "it", capfd)
    assert "Euler" not in error + log


def test_unknown_section_is_not_compared(comm, shared_tmp_path, capfd):
    case = columns({}, STATIC, 3.0 * EULER, section={"it": {"area": np.pi * RADIUS**2, "material": "it"}})
    error, log = run(case, comm, shared_tmp_path / "it", capfd)
    assert "Euler" not in error + log


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_motion_in_stages_and_after_a_restart(integrator, comm, shared_tmp_path, capfd):
    # a load that is suddenly applied gives twice its force, after half a period of several steps
    own = {"integrator": integrator, "end": 4e-3, "step": 1e-4}
    own |= {"beta": 0.25, "gamma": 0.5} if integrator == "newmark" else {}
    stages = [{"name": "one", "time": own}, {"name": "two", "time": own}]
    folder = shared_tmp_path / "it"
    case = columns({}, {"stage": stages}, 0.9 * EULER)
    error, log = run(case, comm, folder, capfd)
    assert error.count("Euler's load") == 1
    (told,) = [line for line in log.splitlines() if "bars were compressed beyond Euler's load in" in line]
    words = told.split()
    at = words.index("of")
    seen, looks, worst = int(words[at - 1]), int(words[at + 1]), told.split("bar 0 with ")[1]
    assert looks == 81 and 10 < seen < 72
    assert 1.70 < float(worst.split(" %")[0]) / 100.0 <= 1.81
    # a run that stops in the second stage and goes on counts the same
    stopped = shared_tmp_path / "stopped"
    with Simulation(case, comm, output=stopped, quiet=True) as simulation:
        for step in simulation:
            if step.step == 57:
                break
    capfd.readouterr()
    error, log = run(case, comm, stopped, capfd, restart=True)
    assert error.count("Euler") == 0  # it has been told before the restart
    assert told.split("bars were")[1] == log.split("bars were")[1].splitlines()[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "analysis", [STATIC, {"time": {"integrator": "central_differences", "step": 1e-5, "end": 1e-4}}]
)
def test_strut_beyond_its_range(analysis, comm, shared_tmp_path, capfd):
    rows = [[0.0, 0, 0, 0], [1.0 if "static" in analysis else 1e-4, 0, 0, -0.4 * LENGTH]]
    support = [
        {"node_set": "feet", "fix": "xyz"},
        {"node_set": "one", "fix": "xyz", "motion": rows, "interpolation": "linear"},
        {"node_set": "two", "fix": "xyz"},
    ]
    material = {"law": "strut", "yield_stress": 3e8}
    error, log = run(columns(material, analysis, 0.0, support=support, load=[]), comm, shared_tmp_path / "it", capfd)
    assert error.count("beyond the range") == 1
    assert "1 bar is shortened beyond the range of the law, most of all bar 0 by" in error
    assert "up to 1 at once, most of all bar 0 by 40 %, where law 'strut' describes 20 %" in log
