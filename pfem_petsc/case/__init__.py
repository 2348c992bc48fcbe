"""Case files as validated models."""
