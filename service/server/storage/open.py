"""The storage that the settings name."""

from service.server.settings import Settings
from service.server.storage.folder import FolderStorage, Storage

SCRATCH = "scratch"
"""Name of the folder, in the data folder, for copies of objects."""


def open_storage(settings: Settings) -> Storage:
    """Open the storage that the settings name; nothing is written into it.

    Raises:
        RequestError: storage_url cannot be used.
    """
    if settings.storage_url is None:
        return FolderStorage(settings.data)
    from service.server.storage.bucket import Bucket
    from service.server.storage.objects import ObjectStorage
    from service.server.storage.scratch import Scratch

    return ObjectStorage(Bucket(settings.storage_url), Scratch(settings.data / SCRATCH, settings.scratch_bytes))
