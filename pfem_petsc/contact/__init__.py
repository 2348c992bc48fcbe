"""Contact of nodes with rigid walls, as bounds on nodal positions."""
