"""What `relit inspect` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Options, Role, Spelling


class InspectRequest(Options):
    """Say what an asset holds, and what is wrong with it: layers, variants, geometry, materials, textures, provenance, validators."""

    asset: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="ASSET")]
    """The asset: .usdz, .usda, .usdc, .usd or .glb."""
    as_json: Annotated[bool, Role.RUN, Spelling(flag="--json")] = False
    """Print JSON, with whole texts and every number."""
