"""Laws with nonlinear hardening, rates and softening in explicit, implicit and static runs."""

import json
import math

import numpy as np
import pytest
from helpers.runs import run
from helpers.stopped import assert_restart_is_bitwise
from helpers.twins import AREA, DENSITY, KEYS, SOFTENING, STEP, STEPS, Twin, integrated, one_bar, pulled

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError

MASS = 0.5 * DENSITY * AREA  # of a node of the bar of 1 m
SETS = [
    ("johnson_cook", "green"), ("voce", "engineering"), ("multilinear", "green"), ("cowper_symonds", "logarithmic"),
    ("ludwik", "green"), ("perzyna", "engineering"), ("ramberg_osgood", "logarithmic"), ("voce", "logarithmic"),
]  # fmt: skip


def force_of(measure, x):
    """Strain, and axial force over area and stress, of the bar whose tip moved by x."""
    stretch = 1.0 + x
    if measure == "green":
        return 0.5 * (stretch * stretch - 1.0), stretch
    return (math.log(stretch), 1.0 / stretch) if measure == "logarithmic" else (x, 1.0)


def thrown(law, measure, integrator):
    """Displacements of the tip, and the bar at the end, by the scheme's formulas."""
    bar, x, v, a = Twin(law, KEYS[law]), 0.0, 70.0, 0.0
    half, found = 70.0, [0.0]
    for _ in range(STEPS):
        if integrator == "central_differences":
            x += STEP * half
            strain, slope = force_of(measure, x)
            bar = bar.step(strain, STEP)
            half -= STEP * AREA / MASS * bar.stress * slope
        else:
            predictor, end, a1 = x + STEP * v + 0.25 * STEP**2 * a, x + STEP * v, a
            for _ in range(60):  # a contraction by (w h)^2/4
                strain, slope = force_of(measure, end)
                trial = bar.step(strain, STEP)
                a1 = -AREA / MASS * trial.stress * slope
                last, end = end, predictor + 0.25 * STEP**2 * a1
                if end == last:
                    break
            v += 0.5 * STEP * (a + a1)
            bar, x, a = trial, end, a1
        found.append(x)
    return np.array(found), bar


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("law", "measure"), SETS)
@pytest.mark.parametrize("scheme", ["assembled", "matrix_free", "explicit"])
def test_thrown_bar_is_integrated_as_by_scipy(scheme, law, measure, comm, shared_tmp_path):
    """Implicit steps with and without a matrix, and explicit ones."""
    integrator = "central_differences" if scheme == "explicit" else "newmark"
    case = one_bar(
        law, integrator, measure, solver={} if scheme == "explicit" else {"operator": scheme, "linear": "cg"}
    )
    case["output"]["fields"] = ["stress", "accumulated_plastic_strain"]
    history = run(Case.from_dict(case), shared_tmp_path / "out")
    expected, bar = thrown(law, measure, integrator)
    moved = np.asarray(history["probe/tip/position"])[:, 0, 0] - 1.0
    assert np.abs(moved - expected).max() < 1e-10 * np.abs(expected).max()
    assert abs(history["energy_imbalance"]).max() < 1e-10 * history["kinetic_energy"][0]
    if comm.rank == 0:
        result = open_result(shared_tmp_path / "out")
        assert result.field("stress", -1)[0] == pytest.approx(bar.stress, rel=1e-9)
        assert result.field("accumulated_plastic_strain", -1)[0] == pytest.approx(bar.a, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "measure"), SETS)
def test_energy_momentum_loses_nothing_but_plastic_work(law, measure, comm, shared_tmp_path):
    case = one_bar(law, "energy_momentum", measure, elements=3)
    history = run(Case.from_dict(case), shared_tmp_path / "conserving")
    assert abs(history["numerical_dissipation"]).max() < 1e-11 * history["kinetic_energy"][0]
    assert history["plastic_dissipation"][-1] > 0.3 * history["kinetic_energy"][0]
    assert (np.diff(history["plastic_heat"]) > -1e-9).all()


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    ("law", "integrator"),
    [("johnson_cook", "newmark"), ("perzyna", "chung_lee"), ("voce", "houbolt"), ("voce", "central_differences")],
)
def test_restart_is_bitwise(law, integrator, comm, shared_tmp_path):
    """A chain that flows while its temperature changes and, where the law takes a table, softens."""
    keys = {} if law == "johnson_cook" else {"softening": SOFTENING}
    case = one_bar(law, integrator, elements=6, steps=60, thermal_expansion=1.2e-5, **keys)
    case["temperature"] = [{"table": [[0.0, 20.0], [6e-4, 500.0]]}]
    fields = ("stress", "plastic_strain", *(["temperature_rise"] if law == "johnson_cook" else []))
    case["output"] |= {"fields": list(fields)}
    assert_restart_is_bitwise(Case.from_dict(case), comm, shared_tmp_path, 24)
    for name in fields:
        assert np.abs(open_result(shared_tmp_path / "whole").field(name, -1)).max() > 0.0, name


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("method", ["newton", "relaxation"])
@pytest.mark.parametrize("law", ["cowper_symonds", "voce"])
def test_static_analyses_take_the_static_curve(law, method, comm, shared_tmp_path):
    case = pulled(law, 0.01, method, elements=3)
    history = run(Case.from_dict(case), shared_tmp_path / "out")
    stress = integrated("voce", [0.01], [1.0], **{key: KEYS[law][key] for key in KEYS["voce"]})[0, 0]
    assert history["probe/tip/reaction"][-1, 0, 0] == pytest.approx(stress * AREA, rel=1e-8)
    stored = history["elastic_energy"][-1] + history["plastic_dissipation"][-1]
    assert stored == pytest.approx(history["external_work"][-1] - history["numerical_dissipation"][-1], rel=1e-9)


@pytest.mark.slow
def test_overstress_relaxes_in_a_static_stage(tmp_path):
    """A bar pulled fast, then held: its stress falls to the static curve."""
    case = one_bar("perzyna", "newmark")
    case["support"].append({"node_set": "tip", "fix": "xyz", "velocity": [50.0, 0.0, 0.0]})
    del case["initial"]
    time, held = case.pop("time") | {"end": 2e-4}, dict(case["support"][1])
    del held["velocity"]
    case["stage"] = [
        {"name": "fast", "time": time},
        {"name": "still", "static": {"step": 1.0}, "support": [case["support"][0], held]},
    ]
    case["output"]["fields_every"] = 1
    history = run(Case.from_dict(case), tmp_path / "out")
    reaction = np.asarray(history["probe/tip/reaction"])[:, 0, 0] / AREA
    static = integrated("perzyna", [0.01], [1e300])[0, 0]
    assert reaction[20] > 1.3 * static
    assert reaction[-1] == pytest.approx(static, rel=1e-2)  # a is larger by the plastic strain of the overstress


def rod(law, speed, **keys):
    """The rod of 5.2 of the paper against a wall, for the time in which its force is constant."""
    young, density, yield_stress = 200e9, 7844.0, 68.95e6
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 0.254, "elements": 100},
            "node_set": {"all": {"all": True}},
            "material": {
                "it": {"law": law, "young_modulus": young, "density": density, "yield_stress": yield_stress, **keys}
            },
            "section": {"it": {"area": 6.45e-4, "material": "it"}},
            "support": [{"node_set": "all", "fix": "yz"}],
            "initial": {"velocity": [speed, 0.0, 0.0]},
            "wall": [{"name": "w", "type": "plane", "point": [0.254, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}],
            "time": {"integrator": "chung_lee", "step": 2e-7, "end": 8e-5},
            "output": {"fields_every": 0},
        }
    )
    return case


@pytest.mark.slow
def test_waves_of_a_rod_with_voce(tmp_path):
    """Impact force s_Y + rho c_p (v - v_Y) of linear hardening; Voce with a small b and Q b = K is that to b a/2."""
    young, density, yield_stress, hardening, speed = 200e9, 7844.0, 68.95e6, 6.9e9, 5.0
    tangent = young * hardening / (young + hardening)
    elastic, plastic = math.sqrt(young / density), math.sqrt(tangent / density)
    force = 6.45e-4 * (yield_stress + density * plastic * (speed - yield_stress / (density * elastic)))
    found = {}
    for name, law, keys in (
        ("line", "elastoplastic", {"isotropic_hardening": hardening}),
        ("curve", "voce", {"saturation_stress": hardening * 1e5, "saturation_rate": 1e-5}),
        ("saturated", "voce", {"saturation_stress": 10e6, "saturation_rate": 690.0}),
    ):
        history = run(rod(law, speed, **keys), tmp_path / name)
        found[name] = -np.asarray(history["wall/w/force"])[:, 0]
    assert np.abs(found["line"] - found["curve"]).max() < 1e-6 * found["line"].max()
    late = slice(150, 400)
    assert abs(found["line"][late]).mean() == pytest.approx(force, rel=1e-2)
    assert abs(found["saturated"][late]).mean() < 0.95 * force


def test_refusals(tmp_path, capsys):
    case = one_bar("voce", "energy_momentum", softening=SOFTENING)
    path = tmp_path / "bar.toml"
    path.write_text(Case.from_dict(case).to_toml())
    assert main(["run", str(path), "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert 'material.it.law = "voce" is not compatible with time.integrator = "energy_momentum"' in said
    assert "softening" in said
    for law, keys, words in (
        ("johnson_cook", {"softening": SOFTENING}, ["material.it.softening", "does not soften by a table"]),
        ("voce", {"softening": [[0.0, 1.0, 1.0], [0.0, 0.5, 0.5]]}, ["row 1", "must increase"]),
        ("voce", {"softening": [[0.0, 1.0, 0.0]]}, ["material.it.softening", "> 0"]),
        ("multilinear", {"curve": [[0.01, 250e6]]}, ["material.it", "end of the elastic line"]),
        ("ludwik", {"hardening_exponent": 1.5}, ["material.it.hardening_exponent", "1"]),
    ):
        with pytest.raises(InputError) as error:
            Case.from_dict(one_bar(law, "newmark", **keys))
        assert all(word in str(error.value) for word in words), str(error.value)


def test_case_with_tables_is_written_and_read(tmp_path):
    """Tables of materials go to results and back as they are."""
    for law, keys in (("multilinear", {"softening": SOFTENING}), ("elastic", {"softening": SOFTENING})):
        case = Case.from_dict(one_bar(law, "newmark", **keys))
        again = Case.from_toml(case.to_toml())
        assert again.material == case.material
        assert json.loads(json.dumps(case.to_dict()))["material"]["it"]["softening"] == SOFTENING


@pytest.mark.slow
def test_critical_step_is_that_of_the_largest_modulus(tmp_path):
    """A bar that becomes four times as stiff while it cools takes half the step from the start."""
    rows = [[-50.0, 4.0, 1.0], [0.0, 1.0, 1.0]]
    found = []
    for keys, temperature in (({}, []), ({"softening": rows}, [{"table": [[0.0, 0.0], [1e-4, -50.0]]}])):
        case = one_bar("elastic", "central_differences", steps=4, **keys) | {"temperature": temperature}
        case["time"] |= {"step": "auto"}
        with Simulation(Case.from_dict(case), output=tmp_path / str(len(keys)), quiet=True) as simulation:
            simulation.start()
            found.append(simulation.plan.critical_step)
            held = simulation.model.bars.heat[1]
            assert not held.any()
    assert found[0] / found[1] == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("damping", [0.0, 50.0])
def test_critical_step_of_slack_cables_is_that_of_taut_ones(damping):
    """Cables that are too long, or hot: they become taut during the run."""
    found = []
    for rest_length, temperature in ((1.0, 0.0), (1.05, 0.0), ([[0.0, 1.05], [1.0, 1.02]], 0.0), (1.0, 100.0)):
        material = {"law": "cable", "young_modulus": 1e6, "density": 1000.0, "thermal_expansion": 1e-4}
        case = {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 3},
            "node_set": {"end": {"indices": [0]}},
            "material": {"m": material | {"damping": damping}},
            "section": {"s": {"area": 1e-4, "material": "m", "rest_length": rest_length}},
            "support": [{"node_set": "end", "fix": "xyz"}],
            "temperature": [{"value": temperature}],
            "time": {"integrator": "central_differences", "step": "auto", "end": 0.1},
        }
        simulation = Simulation(Case.from_dict(case), check_only=True)
        found.append(simulation.plan.critical_step)
        np.testing.assert_allclose(simulation.model.bars.heat[0], 1e-4 * temperature)
    # a constant rest length is that of the mass, too
    assert found == pytest.approx([found[0], found[0] * np.sqrt(1.05), found[0], found[0]], rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "integrator", "keys"),
    [
        ("johnson_cook", "energy_momentum", {}),
        ("multilinear", "central_differences", {"softening": SOFTENING}),
        ("elastic", "energy_momentum", {"softening": SOFTENING}),
    ],
)
def test_bars_of_these_laws_break(law, integrator, keys, tmp_path):
    """In four steps, while heated: what the bar stores is booked as the dissipation of its rupture, nothing is lost."""
    case = one_bar(law, integrator, steps=60, **keys)
    case["material"]["it"] |= {"thermal_expansion": 1.2e-5, "rupture": {"strain": 0.004, "steps": 4}}
    table = [[0.0, 0.0], [6e-4, 200.0]] if law == "elastic" else [[0.0, 100.0], [1.0, 100.0]]
    case["temperature"] = [{"table": table}]
    history = run(Case.from_dict(case), tmp_path / "out")
    start = history["kinetic_energy"][0]
    assert history["rupture_dissipation"][-1] > 1e-3 * start and history["elastic_energy"][-1] == 0.0
    assert abs(history["energy_imbalance"]).max() < 1e-12 * start
    if integrator == "energy_momentum":
        assert abs(history["numerical_dissipation"]).max() < 1e-11 * start
    assert np.ptp(history["probe/tip/velocity"][-10:, 0, 0]) < 1e-9  # flies on


@pytest.mark.slow
def test_data_of_bars_have_values_where_a_run_has_no_bar(tmp_path):
    """Between two rods the columns of a run have no bar: a strut of no slenderness has no stress there."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "two_rods", "length": 0.6, "elements": 9, "gap": 0.002},
            "node_set": {"tip": {"group": "first_end"}},
            "material": {
                "it": {
                    "law": "strut",
                    "young_modulus": 2.8e6,
                    "density": 8700.0,
                    "yield_stress": 5.3e3,
                    "strain": "green",
                }
            },
            "section": {"it": {"area": 1e-4, "material": "it", "shape": "round", "effective_length": 0.5}},
            "initial": {"on": [{"node_set": "tip", "velocity": [0.01, 0.0, 0.0]}]},
            "time": {"integrator": "central_differences", "step": "auto", "end": 2e-2},
        }
    )
    Simulation(case, output=tmp_path / "out", quiet=True).run()
    history = open_result(tmp_path / "out").history
    assert history["elastic_energy"][-1] > 0.01 * history["kinetic_energy"][0]
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * history["kinetic_energy"][0]
