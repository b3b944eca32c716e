"""What a page needs to share light out over the captured lights exactly as `relit relight --weights kernel` does.

Light from between the captured lights is shared by kernel quadrature: its moments are sums over directions, and a small system with them
gives the energies of the lights, none below 0 (service.light.quadrature). Light from beyond the captured lights is shared by a
table over the grid of directions, since its parts add up (service.light.triangulation).
"""

from typing import Any

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.beyond import share_beyond
from kernels.relight.latlong import first_of_equals
from service.light.quadrature import quadrature_of
from service.light.triangulation import share_smooth
from service.viewing.block_file import BlockFile
from service.viewing.transfer import grid_directions
from stage.light_basis import numbers
from stage.point_lights import DistantLights


def write_quadrature(lights: DistantLights, file: BlockFile) -> dict[str, Any]:
    """Write the system and the table, and return what view.json says of them.

    Args:
        lights: of the captured images.
        file: for the blocks.

    Raises:
        OSError: the file cannot be written.
    """
    kept = first_of_equals(lights.direction)
    towards = np.ascontiguousarray(lights.direction[kept], dtype=np.float64)
    solved = quadrature_of(towards)
    directions = grid_directions(1)[:, 0]
    beyond = share_beyond(towards, directions)
    outside = np.zeros((len(directions), len(kept)))
    try:
        outside[:] = share_smooth(directions, np.diag(beyond), towards).T
    except ArrayError:  # too few lights for triangles: the kernel shares that light too
        beyond = np.zeros(len(directions))
    return {"range": numbers(solved.range), "kept": [int(index) for index in kept],
            "inverse": file.append(np.asarray(solved.inverse, dtype=np.float64)),
            "beyond": file.append(beyond.astype(np.float32)), "outside": file.append(outside.astype(np.float32))}
