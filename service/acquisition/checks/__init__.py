"""Checks of pictures while they can be taken again: each check one idea, in a module of its own."""
