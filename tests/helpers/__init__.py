"""What several tests share: cases, bodies, meshes, runs of the program and their comparison."""
