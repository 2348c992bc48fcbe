"""The truss of von Mises, and events of paths."""

from pfem_petsc import Case


def von_mises(*overrides, method="arc_length", **static):
    """The two-bar truss of the built-in case, with other keys of ``[static]``."""
    case = Case.load("von_mises").to_dict()
    for key in ("constraint", "max_step", "min_step"):
        case["static"].pop(key, None)
    case["static"] |= {"method": method, **static}
    case["output"]["fields_every"] = 0
    return Case.from_dict(case, overrides=overrides)


def events(history):
    """Kind, load factor and displacement of each event."""
    return list(zip(history["event/kind"].tolist(), history["event/load_factor"], history["event/displacement"]))
