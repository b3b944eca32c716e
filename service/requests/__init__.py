"""What can be asked of Relit: one frozen model for each kind of work, of which the command line, the API and farm templates are made."""
