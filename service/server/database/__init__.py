"""What the service remembers, in one SQL database: keys, captures, uploads, jobs, workers."""
