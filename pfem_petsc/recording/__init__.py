"""Recording of steps: rows of the history, snapshots, checkpoints, progress."""
