"""Captures taken on the set: lamps switched, patterns shown, pictures taken and checked, and the capture folder written as they come."""
