"""A small case in which each test of this folder introduces one error."""

import pytest

TEXT = """\
[mesh]
generator = "rod"
length = 1.0
elements = 4

[node_set.tip]
nearest = [1.0, 0.0, 0.0]
[node_set.base]
indices = [0]

[material.steel]
young_modulus = 210e9
density = 7850.0

[section.strut]
area = 1e-4
material = "steel"

[[support]]
node_set = "base"
fix = "yz"

[[load]]
node_set = "tip"
force = [1.0, 0.0, 0.0]
table = [[0.0, 0.0], [1.0, 1.0]]

[[wall]]
name = "stop"
type = "plane"
point = [1.1, 0.0, 0.0]
normal = [-1.0, 0.0, 0.0]

[time]
integrator = "central_differences"
step = 1e-6
end = 1e-3

[output]
[[output.probe]]
name = "tip"
node_set = "tip"
"""


@pytest.fixture
def case_text() -> str:
    return TEXT


@pytest.fixture
def case_file(tmp_path, case_text):
    path = tmp_path / "rod.toml"
    path.write_text(case_text)
    return path
