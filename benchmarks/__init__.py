"""The benchmarks that measure the figures of docs/figures.md, and load and fault tests of the service."""
