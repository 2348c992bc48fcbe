"""The environment of processes that tests start."""

from __future__ import annotations

import os

__all__ = ["OF_A_LAUNCH", "environment"]

OF_A_LAUNCH = (
    *("PMIX_", "PMI_", "OPAL_", "ORTE_", "OMPI_COMM_", "OMPI_APP_", "OMPI_UNIVERSE_"),
    *("OMPI_MCA_orte_", "OMPI_MCA_ess", "OMPI_MCA_pmix"),
)
"""Variables that MPI sets in the environment of a process and that would confuse another launch."""


def environment() -> dict[str, str]:
    """Return the environment of a process without a launcher."""
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith((*OF_A_LAUNCH, "PYTEST_XDIST_"))
    }
    allowed = ("OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "OMPI_MCA_rmaps_base_oversubscribe")
    variables |= dict.fromkeys((*allowed, "OMPI_MCA_mpi_yield_when_idle", "OMP_NUM_THREADS"), "1")
    return variables | {"PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
