"""The database of the service: keys, captures and environments, uploads, jobs, workers."""
