"""Static analyses: equilibria under loads, supports, temperatures and walls that follow a load factor."""
