"""What a run has beside its physics: agreements of the ranks, requests to stop, results that are opened."""
