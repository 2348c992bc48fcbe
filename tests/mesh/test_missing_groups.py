"""A group that a mesh does not have is refused with instructions to create one."""

import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

pytestmark = pytest.mark.parallel

BAR = (
    "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n2\n1 0 0 0\n2 1 0 0\n$EndNodes\n"
    "$Elements\n1\n1 1 2 0 1 1 2\n$EndElements\n"
)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"node_set": {"feet": {"group": "feet"}}},
            r'node_set.feet.group = \'feet\': no such group in the mesh; the mesh has no groups '
            r'\(in Gmsh: Physical Point\("feet"\) = \{...\};\)',
        ),
        (
            {"section": {"legs": {"area": 1e-4, "material": "steel", "bars": "legs"}}},
            r'section.legs.bars = .*no such bar group .*; the mesh has no bar groups .*Physical Curve\("legs"\)',
        ),
        (
            {"temperature": [{"value": 1.0, "bars": "warm"}]},
            r'temperature.0..bars = .*no such group of bars; the mesh has no bar groups .*Physical Curve\("warm"\)',
        ),
    ],
)  # fmt: skip
def test_groups_of_a_gmsh_file_without_any(comm, shared_tmp_path, change, text):
    if comm.rank == 0:
        (shared_tmp_path / "bar.msh").write_text(BAR)
    comm.Barrier()
    case = Case.from_dict(
        {
            "mesh": {"file": shared_tmp_path / "bar.msh"},
            "material": {"steel": {"young_modulus": 210e9, "density": 7850.0}},
            "section": {"all": {"area": 1e-4, "material": "steel"}},
            "time": {"integrator": "central_differences", "step": "auto", "end": 1e-3},
            **change,
        }
    )
    with pytest.raises(InputError, match=text):
        Simulation(case, comm, check_only=True)
