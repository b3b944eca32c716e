"""The pages of the service: HTML rendered by the server, and ES modules, which read and write through the API."""
