"""Scene files: records, rules and their words."""
