"""What a run writes of its steps: rows of the history, snapshots, checkpoints, progress."""
