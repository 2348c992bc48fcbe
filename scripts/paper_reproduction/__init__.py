"""The paper's three impact examples, run, measured, drawn and judged."""
