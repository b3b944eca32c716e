"""The service: API, jobs, storage and store."""
