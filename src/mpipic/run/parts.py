"""Every part of the package, so that scenes know all their choices; importing it starts no MPI.

Whoever adds a room with parts imports it here.
"""

from __future__ import annotations

import mpipic.filters
import mpipic.mapping.mass
import mpipic.mesh.basis
import mpipic.particles.layouts
import mpipic.physics.acoustics.midpoint
import mpipic.physics.acoustics.physics
import mpipic.physics.acoustics.slopes
import mpipic.physics.acoustics.solutions  # noqa: F401  parts register when imported
