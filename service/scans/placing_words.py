"""What a fusion says of scans whose poses are wrong, or are not known to be right."""

from collections.abc import Iterator

from service.requests.register import Misplaced
from service.scans.misplaced import LEAST_COMMON, Placing


def placing_warnings(names: list[str], placings: list[Placing], choice: Misplaced) -> Iterator[str]:
    """Yield which scans lie beside the others, and which have nothing in common with any.

    Args:
        names: of the scans.
        placings: of each.
        choice: what becomes of those that lie beside the others.
    """
    for name, placing in zip(names, placings, strict=True):
        if placing.misplaced:
            end = "it was left out" if choice is Misplaced.LEAVE_OUT else "it was fused all the same, and the surface is doubled there"
            yield (f"scan {name}: lies {1e3 * placing.displacement_m:.3g} mm beside the surface of the others, whose noise explains "
                   f"{1e3 * placing.sigma_m:.2g} mm: its pose is wrong, and {end}")
        elif placing.compared < LEAST_COMMON and len(names) > 1:
            yield f"scan {name}: has next to no surface in common with the others, so that nothing tells whether its pose is right"
