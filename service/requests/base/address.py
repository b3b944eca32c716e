"""The address of the service, where nothing else is given."""

DEFAULT_PORT = 8470
DEFAULT_SERVER = f"http://127.0.0.1:{DEFAULT_PORT}"
"""The address at which a client looks for the service."""
