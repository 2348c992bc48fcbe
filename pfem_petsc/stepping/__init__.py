"""Time stepping: the model, its critical step, explicit and implicit steps, and the energy ledger."""
