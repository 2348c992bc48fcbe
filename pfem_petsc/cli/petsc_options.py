"""Options for PETSc on the command line; options without effect are reported."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from .parser import PROGRAM

__all__ = ["PREFIXES", "start_petsc", "without_effect"]

PREFIXES = ("pfem_contact_", "pfem_assembled_", "pfem_coarse_", "pfem_mass_", "pfem_")
"""Prefixes of the program's solvers, described in docs/linear_solvers.md."""

_SOLVER = ("snes_", "ksp_", "pc_", "mg_", "sub_", "mat_mumps_", "esteig_", "linesearch_")
_FILES = ("-options_file", "-options_file_yaml")


def start_petsc(options: Sequence[str], rank: int) -> None:
    """Start PETSc with options; rank 0 warns about those without effect.

    Raises
    ------
    InputError
        If an options file is missing, or PETSc rejects an option.
    """
    import petsc4py

    _check_files(options)
    try:
        petsc4py.init([PROGRAM, *options])
        from petsc4py import PETSc
    except Exception as error:
        if type(error).__name__ != "Error":  # PETSc.Error cannot be imported before PETSc is started
            raise
        raise InputError(f"PETSc does not start with the options {' '.join(options)}: {error}") from error
    del PETSc
    if rank == 0:
        for line in without_effect(options):
            print(f"warning: {line}", file=sys.stderr, flush=True)


def without_effect(options: Sequence[str]) -> list[str]:
    """Return one line for each solver option that none of the program's solvers reads."""
    lines = []
    for word in options:
        name = word.lstrip("-")
        if not re.match(r"--?[A-Za-z]", word) or not (name.startswith("pfem_") or name.startswith(_SOLVER)):
            continue
        prefix = next((p for p in PREFIXES if name.startswith(p)), "")
        rest = name.removeprefix(prefix)
        if prefix and rest.startswith(_SOLVER):
            continue
        at = min((found.start() for found in re.finditer("|".join(_SOLVER), rest)), default=None)
        wanted = difflib.get_close_matches(rest[:at] if at else "", PREFIXES, n=1, cutoff=0.4) if prefix else []
        near = f"; did you mean -{(wanted or ['pfem_'])[0]}{rest[at:]}?" if at is not None else ""
        lines.append(
            f"the PETSc option {word} has no effect: options of the solvers begin with one of "
            f"{', '.join('-' + p for p in reversed(PREFIXES))} (docs/linear_solvers.md){near}"
        )
    return lines


def _check_files(options: Sequence[str]) -> None:
    for k, word in enumerate(options):
        if word in _FILES:
            file = options[k + 1] if k + 1 < len(options) else ""
            if not Path(file).is_file():
                raise InputError(f"{word} {file}: there is no such file; name a file of PETSc options after {word}")
