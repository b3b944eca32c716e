"""The processes of the service: their start, supervision, connections, clean-up and backup."""
