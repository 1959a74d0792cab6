"""Files: run directories, particle snapshots, particle files."""
