"""Kinds of wall, one a module; the module's name is the ``type`` that case files use."""
