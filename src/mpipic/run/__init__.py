"""From a scene to its run: build, loop, measure, tell."""
