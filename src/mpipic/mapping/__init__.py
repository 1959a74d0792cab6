"""Between particles and nodes: Φ, D, S and G, their sums, solvers and masses."""
