"""Lattices: unit cells repeated in a block, which is graded, disturbed, curved and cut."""
