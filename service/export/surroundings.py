"""What an asset of solved maps brings along: the options rig, environment and card, checked before anything is written."""

from service.asset.card import find_frames
from service.errors import RequestError
from service.requests.export import ExportRequest
from service.usd.surroundings import Surroundings
from stage.camera import Camera
from stage.capture import Capture
from stage.environment_maps import check_environment
from stage.fingerprint import combined, digest
from stage.manifest import FILE_NAME

OPTIONS = ("rig", "environment", "card")


def refuse_surroundings(request: ExportRequest) -> None:
    """Refuse the options where an asset has no place for what they ask for.

    Raises:
        RequestError: one of them is given.
    """
    given = " and ".join(f"--{name}" for name in OPTIONS if getattr(request, name) is not None)
    if given:
        raise RequestError(f"{given}: lights and frames go with solved maps, into a .usdz, .usda or .usdc: leave the option out")


def open_surroundings(request: ExportRequest, camera: Camera) -> Surroundings:
    """Open and check what the asset brings along.

    Args:
        camera: of the maps.

    Raises:
        RequestError: the capture has another camera.
        ManifestError, ImageError, AssetError, StorageError: what the capture, the environment or the frames lack.
    """
    rig = None if request.rig is None else Capture.open(request.rig, request.pixels)
    if rig is not None and rig.camera != camera:
        differs = [name for name, value in rig.camera if value != getattr(camera, name)]
        raise RequestError(f"--rig {request.rig}: its camera differs from that of the maps in {', '.join(differs)}: "
                           "name the capture that was solved")
    if request.environment is not None:
        check_environment(request.environment)
    card = None if request.card is None else find_frames(request.card, camera)
    return Surroundings(rig, request.environment, card, {} if request.clip_negative else None)


def content_hashes(surroundings: Surroundings) -> dict[str, str]:
    """Return the content hashes of what the asset brings along, by the names of the options."""
    found = {}
    if surroundings.rig is not None:
        found["rig"] = digest(surroundings.rig.folder / FILE_NAME)
    if surroundings.environment is not None:
        found["environment"] = digest(surroundings.environment)
    if surroundings.card is not None:
        found["card"] = combined(digest(frame) for frame in surroundings.card.values())
    return found
