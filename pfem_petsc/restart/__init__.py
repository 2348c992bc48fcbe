"""Checkpoints of a run and their way back: what is saved, which one is taken, and what may have changed since."""
