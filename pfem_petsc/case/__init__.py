"""Case files as checked models."""
