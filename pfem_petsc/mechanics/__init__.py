"""The positional bar element, its materials, mass, loads and supports."""
