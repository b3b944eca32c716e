"""Requests to Relit: one frozen model for each kind of work, from which the command line, the API and farm templates are made."""
