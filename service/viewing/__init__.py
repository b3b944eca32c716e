"""What the pages of the service show of a capture and of its solved or depth maps (relit.view/1)."""
