"""Pieces of work that several devices and workers share: of a solve, and of a fusion of scans."""
