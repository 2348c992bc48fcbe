"""Killed, restarted and compared on 1, 2, 3, 5 and 8 ranks of five nodes: some own one, some nothing."""

import shutil

import numpy as np
import pytest

from pfem_petsc.cli.main import main
from pfem_petsc.output.result import open_result

CASE = """
[mesh]
generator = "rod"
length = 1.0
elements = 4
[node_set.tip]
nearest = [1.0, 0.0, 0.0]
[material.it]
young_modulus = 1.0
density = 1.0
yield_stress = 0.15
isotropic_hardening = 0.1
kinematic_hardening = 0.1
[section.it]
area = 1.0
material = "it"
[initial]
velocity = [0.5, 0.1, 0.0]
angular_velocity = [0.0, 0.0, 0.2]
[[wall]]
name = "wall"
type = "plane"
point = [1.02, 0.0, 0.0]
normal = [-1.0, 0.0, 0.0]
[time]
integrator = "{scheme}"
step = 0.02
end = 0.8
[solver]
rtol = 1e-13
[output]
fields_every = 7
history_every = 3
checkpoint_every = 10
[[output.probe]]
name = "tip"
node_set = "tip"
"""


def alone(folder, scheme):
    """A case file, and beside it the results on one rank."""
    path = folder / "five.toml"
    path.write_text(CASE.format(scheme=scheme))
    assert main([str(path), "--quiet", "-o", str(folder / "alone")]) == 0
    with open_result(folder / "alone") as result:
        assert result.history["wall/wall/contacts"].max() > 0
        assert result.history["plastic_heat"][-1] > 1e-4
    return path


def assert_near(one, other):
    """Positions and history of two results to 1e-10 of the truss, its energy, momentum and forces."""
    with open_result(one) as a, open_result(other) as b:
        np.testing.assert_array_equal(a.history["step"], b.history["step"])
        np.testing.assert_array_equal(a.steps, b.steps)
        for i in range(len(a.times)):
            assert np.abs(a.positions(i) - b.positions(i)).max() < 1e-10
        for name in a.history:
            assert np.abs(np.asarray(a.history[name], float) - b.history[name]).max() < 1e-10, name


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["houbolt", "central_differences"])
def test_restart_from_two_ranks_on_one_and_three(tmp_path, scheme, on_ranks):
    case = alone(tmp_path, scheme)
    words = ("-m", "pfem_petsc", case, "--quiet", "-o")
    done = on_ranks(2, *words, tmp_path / "half", "--set", "time.end=0.42")
    assert done.returncode == 0, done.stderr
    for ranks in (1, 3):
        folder = shutil.copytree(tmp_path / "half", tmp_path / str(ranks))
        done = on_ranks(ranks, *words, folder, "--restart", "--set", "time.end=0.8")
        assert done.returncode == 0, done.stderr
        assert_near(tmp_path / "alone", folder)
