"""Particles: named fields, layouts, motion and migration."""
