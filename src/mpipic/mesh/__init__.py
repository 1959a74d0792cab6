"""Nodes: the grid and its ranks, ghost nodes, splines, differences on nodes."""
