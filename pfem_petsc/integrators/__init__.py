"""Time integrators, one a module; the module's name is the one that case files use."""
