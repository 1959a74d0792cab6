"""Scene files: records, rules and their words. The sections that are no room's join the parts with this one."""

import mpipic.scene.sections  # noqa: F401  what every scene has, registered when imported
