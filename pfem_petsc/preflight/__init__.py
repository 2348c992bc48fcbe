"""Checks before a run: connectivity and bracing of the truss, plausible values, memory, time and disk space."""
