"""A loop that is limited by memory alone: what the others are measured against."""

from mpipic.kernels.common import hot


@hot
def triad(a, b, c, scale):
    """Set a = b + scale c, elementwise; (n,) each. Reads 16 and writes 8 bytes an element."""
    for i in range(a.size):
        a[i] = b[i] + scale * c[i]
