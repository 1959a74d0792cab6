"""Settings of every test: examples drawn by hypothesis are the same in each run."""

from hypothesis import settings

# `pytest --hypothesis-profile=default` searches anew.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
