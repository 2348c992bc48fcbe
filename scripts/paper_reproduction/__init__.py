"""The three impact examples of the paper: runs, measurements, figures and verdicts."""
