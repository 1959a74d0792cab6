"""The room in which the paper is redrawn: its figures, its claims held against numbers, and one page of both."""
