"""The HTTP API under /v1. The only place with fastapi; it hands jobs in and never does one."""
