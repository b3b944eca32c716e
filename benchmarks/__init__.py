"""The figures that docs/figures.md shows, each measured by the code here."""
