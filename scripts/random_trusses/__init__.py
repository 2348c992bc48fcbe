"""Random valid cases, and what must hold of their results: see ``scripts/random_cases.py``."""
