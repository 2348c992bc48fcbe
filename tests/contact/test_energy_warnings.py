"""Warnings about energy gained in steps without contact, and booked as dissipated although it never was there."""

from types import SimpleNamespace

import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.columns import LOST, STORED, SUPPLIED
from pfem_petsc.run.monitors import CAUSES, ContactWatch


def rod_held_at_one_end(integrator, step, **material):
    """A rod that flies off its support, in steps over the explicit limit, without any contact."""
    length, bars, young, density = 1.0, 4, 1e7, 1e3
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": length, "elements": bars},
            "material": {"it": {"young_modulus": young, "density": density, **material}},
            "section": {"it": {"area": 1e-4, "material": "it"}},
            "node_set": {"start": {"group": "start"}},
            "support": [{"node_set": "start", "fix": "xyz"}],
            "initial": {"velocity": [2.0, 0.0, 0.0]},
            "time": {
                "integrator": integrator,
                "step": step * length / bars / (young / density) ** 0.5,
                "end": 30 * step * length / bars / (young / density) ** 0.5,
            },
        }
    )


@pytest.mark.parametrize(
    ("integrator", "step", "material", "cause"),
    [
        ("generalized_alpha", 4.0, {"yield_stress": 2e4}, "bars yield"),
        ("newmark", 1.0, {"damping": 2e6}, "damping stops nodes"),
        ("generalized_alpha", 0.5, {"yield_stress": 2e4}, None),
        ("newmark", 0.5, {"damping": 2e3}, None),
        ("energy_momentum", 4.0, {"yield_stress": 2e4}, None),
        ("central_differences", 0.9, {"yield_stress": 5e4}, "bars yield"),
        ("central_differences", 0.6, {"yield_stress": 8e4}, "bars yield"),
        ("central_differences", 0.1, {"yield_stress": 5e4}, None),
        ("central_differences", 0.9, {}, None),
        ("chung_lee", 0.8, {"damping": 2e3}, None),
    ],
)
def test_energy_that_steps_make_without_contact_is_told(integrator, step, material, cause, tmp_path, capfd):
    run = Simulation(rod_held_at_one_end(integrator, step, **material), MPI.COMM_SELF, output=tmp_path, quiet=True)
    assert any("damping dissipation" in text for text in run.model.warnings) == (cause == "damping stops nodes")
    run.run()
    told = capfd.readouterr().err
    if cause is None:
        assert "has grown by" not in told
    else:
        assert told.count("has grown by") == 1
        assert f"({cause})" in told


def test_the_remedy_for_automatic_steps_is_their_safety(tmp_path):
    given = rod_held_at_one_end("central_differences", 0.9, yield_stress=5e4).to_dict()
    given["time"] |= {"step": "auto", "safety": 0.95}
    Simulation(Case.from_dict(given), MPI.COMM_SELF, output=tmp_path, quiet=True).run()
    assert "has grown by" in (told := (tmp_path / "log.txt").read_text()) and "reduce time.safety" in told


def watched(rows, explicit=False, moves=False):
    """Warnings about rows of a history, given as changes of a run of 10 steps that stores 1 J."""
    model = SimpleNamespace(
        rounding=1e-12,
        length=1.0,
        supports=SimpleNamespace(moves=moves),
        case=SimpleNamespace(
            contact=SimpleNamespace(treatment="scheme"),
            time=SimpleNamespace(step=0.1, integrator="wilson", mass="lumped"),
        ),
    )
    scheme, frequency = SimpleNamespace(explicit=explicit), SimpleNamespace(upper=1.0)
    told = []
    watch = ContactWatch(model, told.append, SimpleNamespace(scheme=scheme, frequency=frequency, step=0.1, steps=10))
    still = dict.fromkeys((*STORED, *LOST, *SUPPLIED), 0.0) | {"kinetic_energy": 1.0, "active_contacts": 0}
    for step in range(11):
        row = {**still, "step": step, "time": 0.1 * step, **rows(step)}
        watch.check(row, row)
    return told


@pytest.mark.parametrize("name", CAUSES)
def test_energy_that_is_booked_as_dissipated_and_never_was_there_is_told(name):
    """Every way in which bars and damping dissipate counts, with implicit and with explicit steps."""
    for explicit in (False, True):
        (told,) = watched(lambda step: {name: 0.3 if step > 2 else 0.0}, explicit)
        assert (
            "step 6, t = 0.6 s" in told and "30 % of the energy that the run had or was given, without contact" in told
        )
        assert f"({CAUSES[name]})" in told and "reduce time.step" in told
    assert watched(lambda step: {name: 0.3, "kinetic_energy": 0.7} if step > 2 else {}) == []


def test_a_gain_with_which_a_run_ends_is_told():
    """A peak that passes within three rows is none, and two rows at the end are."""
    assert watched(lambda step: {"elastic_energy": 0.5 if 4 <= step < 7 else 0.0}) == []
    (told,) = watched(lambda step: {"external_work": -0.5 if step >= 9 else 0.0}, moves=True)
    assert "step 10" in told and "(supports move)" in told
    assert watched(lambda step: {"elastic_energy": 0.5 if step >= 10 else 0.0}) == []
