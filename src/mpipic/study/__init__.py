"""Sweeps of runs: error against run time."""
