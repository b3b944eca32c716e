"""Errors of the USD export. The disk refusing is stage.errors.StorageError, as everywhere.

AssetError    these maps, or this path, cannot become a USD asset; says what is missing and what to do
"""


class AssetError(ValueError):
    """The maps or the path cannot become a USD asset; its text is one plain sentence."""
