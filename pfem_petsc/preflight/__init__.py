"""What is looked at before a run: is the truss connected and braced, are the numbers sane, will it fit."""
