"""Equations of motion, one package each; a step sees no ranks, files or scenes."""
