"""Kills at random times; scripts/endurance.py makes hundreds."""

import random

import pytest
from helpers.kills import KINDS, VtkReader, assert_readable, differences, killed, run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ranks"),
    [
        ("explicit contact, plastic", 1),
        ("explicit, snapshots beside the steps", 1),
        ("implicit contact", 1),
        ("multistep", 1),
        ("explicit contact, plastic", 2),
        ("explicit, snapshots beside the steps", 2),
    ],
)
def test_killed_at_random_moments_the_run_ends_as_if_undisturbed(tmp_path, name, ranks):
    seed = random.SystemRandom().randrange(10**6)
    print(f"seed {seed}")  # shown where the test fails
    chance, kind, folder = random.Random(seed), KINDS[name], tmp_path / "killed"
    done = run(kind, ranks, tmp_path / "whole", 0)
    assert done.returncode == 0, done.stderr
    restart = []
    with VtkReader() as vtk:
        for _ in range(2):
            print(killed(kind, ranks, folder, chance.choice([5, 30]), 0.7, chance, *restart))
            restart = ["--restart"]
            if (folder / "result.vtkhdf").exists():
                assert_readable(folder / "result.vtkhdf", vtk)
    done = run(kind, ranks, folder, 30, "--restart")
    assert done.returncode == 0, done.stderr
    assert differences(tmp_path / "whole" / "result.vtkhdf", folder / "result.vtkhdf") == {}
