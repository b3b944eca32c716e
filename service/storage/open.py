"""The storage that the settings ask for."""

from service.settings import Settings
from service.storage.folder import FolderStorage, Storage


def open_storage(settings: Settings) -> Storage:
    """Open the storage; nothing is written."""
    return FolderStorage(settings.data)
