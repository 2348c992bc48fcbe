"""Strong and weak scaling studies: points, tables, plots, and a model of larger machines."""
