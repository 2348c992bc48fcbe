"""The command line of a rod that hits a wall, and the steps of its results."""

from pfem_petsc.output.result import open_result

ROD = ["rod_impact", "--quiet", "--set", "output.checkpoint_every=20"]


def rod(folder, *more, end=0.5):
    return [*ROD, f"time.end={end}", "-o", str(folder), *more]


def steps(folder):
    with open_result(folder) as result:
        return result.history["step"], result.steps
