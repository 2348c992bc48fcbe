"""Meshes made by rule: one module each, named as in case files."""
