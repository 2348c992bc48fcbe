"""docs/case_file.md documents every key of a case file, and its example is valid."""

from __future__ import annotations

import re
from pathlib import Path

import document_case
import pytest
from document_laws import BEGIN, END, text_of, undocumented
from mpi4py import MPI

from pfem_petsc import Simulation, open_result
from pfem_petsc.case.files import TableFile
from pfem_petsc.case.model import ANALYSES, STAGE_TABLES
from pfem_petsc.case.schema import Case
from pfem_petsc.case.tables import Rupture
from pfem_petsc.formats import read_whole
from pfem_petsc.mechanics.materials.base import LAWS
from pfem_petsc.registry import choices, lookup

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "case_file.md").read_text()
ELSEWHERE = ("[[wall]]", "[[constraint]]", "[[contact_pair]]", "[contact]", "[material.", "Columns")
"""Tables that have a page or section of their own."""
MODELS = [
    model
    for heading, models in document_case.TABLES.items()
    for model in models
    if isinstance(model, type) and not heading.startswith(ELSEWHERE)
] + [lookup("pfem_petsc.mesh.generators", name, "").Parameters for name in choices("pfem_petsc.mesh.generators")]


def named(text: str) -> set[str]:
    quoted = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    return {word for span in quoted for word in re.findall(r"\w+", span)}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_every_key_is_named(model):
    assert set(model.model_fields) - {getattr(model, "slot", None)} <= named(TEXT)


def test_every_key_of_files_is_named():
    assert set(TableFile.model_fields) <= named((DOCS / "loads.md").read_text())


@pytest.mark.parametrize("law", choices(LAWS))
def test_every_key_of_a_law_has_a_text(law):
    assert undocumented(law) == []


def test_keys_of_laws_are_those_of_their_parameters():
    """What ``scripts/document_laws.py`` writes, law by law; a law that it has not seen yet is no fault."""
    made = TEXT.partition(BEGIN)[2].partition(END)[0]
    documented = re.findall(r"^#### `(\w+)`$", made, flags=re.MULTILINE)
    assert {"elastic", "elastoplastic", "voce", "johnson_cook"} <= set(documented)
    for law in ("", *documented):
        assert text_of(law) in made, f"{law or 'every material'}: run scripts/document_laws.py"


def test_every_limit_of_rupture_is_named():
    assert set(Rupture.model_fields) <= named((DOCS / "rupture.md").read_text())


def test_every_key_of_walls_is_named():
    text = named((DOCS / "contact.md").read_text())
    for kind in choices("pfem_petsc.contact.walls"):
        assert set(lookup("pfem_petsc.contact.walls", kind, "").Parameters.model_fields) <= text, kind


def test_example_is_read(tmp_path):
    case = Case.from_toml(re.search(r"^```toml\n(.*?)^```$", TEXT, flags=re.MULTILINE | re.DOTALL)[1], tmp_path)
    assert [load.force for load in case.load] == [(0.0, 0.0, -5e4)]
    mesh = read_whole(DOCS.parent / "meshes" / case.mesh.file.name)
    assert {"left", "right"} <= set(mesh.node_groups)
    assert {"chords"} <= set(mesh.bar_groups)
    assert case.temperature[0].bars == case.section["chord"].bars == "chords"


def test_every_key_of_static_methods_is_named():
    text = "".join(path.read_text() for path in sorted(DOCS.glob("statics*.md")))
    for method in choices("pfem_petsc.statics.methods"):
        parameters = lookup("pfem_petsc.statics.methods", method, "").Parameters
        assert set(parameters.model_fields) <= named(text), method


@pytest.mark.slow
def test_example_of_stages_runs(tmp_path):
    text = (DOCS / "stages.md").read_text()
    case = Case.from_toml(re.search(r"^```toml\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)[1], tmp_path)
    assert set(STAGE_TABLES) | set(ANALYSES) <= named(text)
    with Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    history = open_result(tmp_path / "out").history
    assert history["momentum"][204, 0] > 0.0 > history["momentum"][-1, 0]
    assert abs(history["energy_imbalance"]).max() < 1e-9 * history["elastic_energy"].max()
