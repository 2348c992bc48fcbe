"""One bar, or a row of bars, in motion and in statics."""

from helpers.laws import DENSITY, KEYS, YOUNG

AREA, STEP, STEPS = 1e-4, 1e-5, 100
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}  # the trapezoidal rule


def one_bar(law, integrator, measure="engineering", speed=70.0, steps=STEPS, elements=1, solver=None, **keys):
    """A bar of 1 m along x: its foot is held, its tip is thrown."""
    material = {"law": law, "young_modulus": YOUNG, "density": DENSITY, "strain": measure, **KEYS.get(law, {}), **keys}
    table = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": elements},
        "node_set": {"foot": {"nearest": [0.0, 0.0, 0.0]}, "tip": {"nearest": [1.0, 0.0, 0.0]}},
        "material": {"it": material},
        "section": {"it": {"area": AREA, "material": "it"}},
        "initial": {"on": [{"node_set": "tip", "velocity": [speed, 0.0, 0.0]}]},
        "support": [{"node_set": "foot", "fix": "xyz"}],
        "time": {"integrator": integrator, "step": STEP, "end": STEP * steps, **PARAMETERS.get(integrator, {})},
        "solver": {"rtol": 1e-13, **(solver or {})},
        "output": {"fields_every": steps, "fields": ["stress"], "probe": [{"name": "tip", "node_set": "tip"}]},
    }
    return table


def pulled(law, strain, method="newton", **keys):
    """A bar whose tip is moved, in a static analysis."""
    case = one_bar(law, "newmark", **keys)
    for key in ("time", "initial"):
        del case[key]
    case["static"] = {"method": method, "step": 0.2}
    case["node_set"]["all"] = {"all": True}
    moved = {"node_set": "tip", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, strain, 0.0, 0.0]]}
    case["support"] = [{"node_set": "foot", "fix": "x"}, {"node_set": "all", "fix": "yz"}, moved]
    return case
