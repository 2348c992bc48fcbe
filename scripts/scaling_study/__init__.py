"""Strong and weak scaling studies: what to run, tables, plots, and a model of larger machines."""
