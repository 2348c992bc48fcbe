"""Treatments of impact, one per module; the module's name is the ``treatment`` that case files use."""
