"""Methods that find equilibria, one per module; ``static.method`` names the module."""
