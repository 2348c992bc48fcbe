import numpy as np
import pytest
from helpers.meshes import slab_from

from pfem_petsc.errors import InputError
from pfem_petsc.mesh.whole import check_mesh

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
ROUND = [[0, 1], [1, 2], [2, 3], [3, 0]]


@pytest.mark.parallel
@pytest.mark.parametrize(
    ("points", "bars", "text"),
    [
        (SQUARE, [*ROUND, [2, 1]], r"1 bars join the same two nodes .* bars 1 and 4 \(nodes 1 and 2\); keep one"),
        (SQUARE, [*ROUND, [0, 1]], r"bars 0 and 4 \(nodes 0 and 1\)"),
        (SQUARE, [*ROUND, [2, 2]], r"1 bars start and end at the same node: bar 4 \(nodes 2 and 2\)"),
        ([*SQUARE, [1, 1, 0]], [*ROUND, [2, 4]], r"a length that is zero .* bar 4 \(nodes 2 and 4\), length 0"),
        (SQUARE, [*ROUND, [3, 4]], r"an end that does not exist: bar 4 \(nodes 3 and 4\); .* 0 to 3"),
        (SQUARE, [*ROUND, [-1, 2]], r"an end that does not exist: bar 4 \(nodes -1 and 2\)"),
        ([*SQUARE, [5, 5, 5]], ROUND, r"1 nodes belong to no bar: node 4; remove"),
        ([[0, 0, np.nan], *SQUARE[1:]], ROUND, r"1 nodes have coordinates .* node 0 at \(0, 0, nan\)"),
        ([*SQUARE[:3], [np.inf, 0, 0]], ROUND, r"node 3 at \(inf, 0, 0\)"),
        ([*SQUARE[:3], [1e200, 0, 0]], ROUND, r"node 3 at \(1e\+200, 0, 0\)"),
        (SQUARE, [], r"4 nodes and 0 bars: nothing to simulate"),
        ([], [], r"0 nodes and 0 bars"),
    ],
)
def test_what_cannot_be_simulated_is_refused_on_all_ranks(comm, points, bars, text):
    with pytest.raises(InputError, match=f"^test mesh: .*{text}"):
        check_mesh(slab_from(points, bars, comm), comm)


def test_the_first_few_are_named_and_all_counted(comm):
    n = 40
    points = [[i, 0, 0] for i in range(n)]
    bars = [[i, i + 1] for i in range(n - 1)] + [[i + 1, i] for i in range(20)]
    with pytest.raises(InputError, match=r"20 bars join .*bars 0 and 39 .*, bars 4 and 43 \(nodes 4 and 5\), \.\.\.;"):
        check_mesh(slab_from(points, bars, comm), comm)


def test_short_bars_are_a_warning(comm):
    points = [*SQUARE, [0, 1 + 1e-8, 0]]
    (warning,) = check_mesh(slab_from(points, [*ROUND, [3, 4], [4, 0]], comm), comm)
    assert warning.startswith("test mesh: 1 bars are far shorter than the mean length 0.83")
    assert "bar 4 (nodes 3 and 4), length 1e-08 m" in warning


@pytest.mark.parallel
def test_warnings_of_the_reader_are_kept_on_all_ranks(comm):
    slab = slab_from(SQUARE, ROUND, comm)
    slab.warnings = ["left out 3 elements"] if comm.rank == 0 else []
    assert check_mesh(slab, comm) == ["left out 3 elements"]


def test_a_structured_mesh_is_taken_as_sound(comm):
    slab = slab_from(SQUARE, [*ROUND, [1, 0]], comm)
    slab.structured = True
    assert check_mesh(slab, comm) == []
