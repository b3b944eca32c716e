"""Lighting reproduction: the levels at which the lamps of a rig light a subject as an environment would."""
