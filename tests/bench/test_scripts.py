"""The scaling study's resumption, and the meshes and the bare loop of the comparison with peers."""

import model as peers
import numpy as np
from scaling import Point, noise_of


def test_peers_lattice_is_the_generators():
    from pfem_petsc.mesh.generators import lattice

    points, bars = peers.lattice(3)
    slab = lattice.generate(lattice.Parameters(kind="cubic", cells=(3, 3, 3), pitch=peers.PITCH), 0, 1)

    def as_set(points, bars):
        places = np.round(points / peers.PITCH).astype(int)
        return {frozenset(map(tuple, places[ends])) for ends in bars}

    assert as_set(points, bars) == as_set(slab.points, slab.bars)
    assert len(bars) == len(slab.bars)


def test_points_with_other_programs_beside_them_are_marked():
    quiet = {"step_s": 1.0, "best_s": 0.95, "bandwidth_alone": 1e10, "bandwidth_ratio": 1.3, "ranks": 2}
    assert noise_of(quiet, 1.1e10) == ""
    assert noise_of(quiet | {"step_s": 1.5}, 1e10) == "repeats differ 1.58 x"
    assert noise_of(quiet | {"bandwidth_alone": 6e9}, 1e10) == "one process had 0.60 x the best bandwidth"
    for ratio in (0.7, 2.6):  # two processes have neither less than one nor more than twice as much
        assert noise_of(quiet | {"bandwidth_ratio": ratio}, 1e10) == f"bandwidth ratio {ratio:.2f} of 2 processes"


def test_points_of_both_studies_share_runs():
    whole, part = (Point(study, "cubic", "explicit", "newmark", 1000, 1) for study in ("strong", "weak"))
    assert whole.file == part.file
    assert part._replace(ranks=2).file == whole._replace(size=2000, ranks=2).file != whole._replace(ranks=2).file
