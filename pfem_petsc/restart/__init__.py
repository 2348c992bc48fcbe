"""Restart: the content of checkpoints, the choice of one, and the changes that are allowed since it was written."""
