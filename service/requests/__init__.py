"""What can be asked of Relit: one frozen model a job, the same for the command line, the API, the farm and the provenance record."""
