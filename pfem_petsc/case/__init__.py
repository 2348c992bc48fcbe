"""Case files: what a simulation is told, as checked models."""
