"""Linearised gas dynamics about a uniform flow."""
