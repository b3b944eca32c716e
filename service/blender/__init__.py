"""Relit in Blender: an extension, whose modules run in Blender alone, and the command that packs it."""
