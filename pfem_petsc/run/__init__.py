"""A run around its analysis: outputs, synchronisation of the ranks, requests to stop."""
