"""Data for the pages that show a capture and its solved or depth maps (relit.view/1)."""
