"""More ranks than nodes: ranks that own nothing."""

import numpy as np
import pytest

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
end = 0.2
[solver]
rtol = 1e-13
[[output.probe]]
name = "tip"
node_set = "tip"
"""


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_five_nodes_on_eight_ranks(scheme, tmp_path, on_ranks):
    (tmp_path / "five.toml").write_text(CASE.format(scheme=scheme))
    ends = []
    for ranks in (1, 8):
        done = on_ranks(ranks, "-m", "pfem_petsc", "five.toml", "-o", f"on_{ranks}", "--quiet", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        result = open_result(tmp_path / f"on_{ranks}")
        ends.append(result.positions(-1))
        assert result.history["active_contacts"].max() == 1
        assert result.history["probe/tip/position"].shape == (11, 1, 3)
    assert np.abs(ends[0] - ends[1]).max() < 1e-12
