"""Lights that a solve finds or refines, and what their images contradict."""
