"""Null-space filters: what they keep of particle values, and how."""
