"""Mesh generators, one per module; the module's name is the one that case files use."""
