"""The commands of the service and its clients."""
