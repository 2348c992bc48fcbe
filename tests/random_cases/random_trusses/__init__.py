"""Random valid cases, and properties that their results must have; see ``scripts/random_cases.py``."""
