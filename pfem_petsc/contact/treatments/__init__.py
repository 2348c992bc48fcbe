"""Treatments of impact, one a module; the module's name is the ``treatment`` that case files use."""
