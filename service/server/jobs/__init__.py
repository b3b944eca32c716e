"""Durable jobs: the queue, the workers, and how work survives their death. The only place with dbos."""
