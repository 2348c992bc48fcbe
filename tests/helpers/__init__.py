"""Helpers shared by several tests: cases, bodies, meshes, runs of the program and their comparison."""
