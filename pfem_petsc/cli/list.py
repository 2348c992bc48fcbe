"""List the built-in cases, integrators, mesh generators and formats, walls, constraints, treatments, static methods."""

from __future__ import annotations

import argparse
import tomllib

from ..case.toml import built_in_cases, built_in_path
from ..registry import choices, description
from .parser import PROGRAM

RANKS = "one, without MPI"

EXAMPLE = f"""\
example:
  {PROGRAM} list"""

KINDS = {
    "integrators": "pfem_petsc.integrators",
    "mesh generators": "pfem_petsc.mesh.generators",
    "mesh formats": "pfem_petsc.formats",
    "material laws": "pfem_petsc.mechanics.materials",
    "walls": "pfem_petsc.contact.walls",
    "constraints": "pfem_petsc.contact.constraints",
    "treatments of impact": "pfem_petsc.contact.treatments",
    "methods of static analyses": "pfem_petsc.statics.methods",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no options: the verb has none of its own."""


def run(arguments: argparse.Namespace) -> int:
    """Print the lists."""
    sections = {"built-in cases": {name: _title(name) for name in built_in_cases()}}
    for kind, package in KINDS.items():
        sections[kind] = {name: description(package, name) for name in choices(package)}
    width = max(len(name) for lines in sections.values() for name in lines)
    for kind, lines in sections.items():
        print(f"{kind}:")
        if not lines:
            print("  none is built in; CONTRIBUTING.md has an example and says how to add one")
        for name, text in lines.items():
            print(f"  {name:{width}}  {text}")
    return 0


def _title(name: str) -> str:
    return tomllib.loads(built_in_path(name).read_text(encoding="utf-8"))["title"]
