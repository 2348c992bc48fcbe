"""Wall types, one per module; the module's name is the ``type`` that case files use."""
