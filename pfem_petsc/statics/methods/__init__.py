"""Methods that find equilibria, one module each: ``static.method`` names it."""
