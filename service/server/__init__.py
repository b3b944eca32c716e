"""The service: its API, jobs, database and storage."""
