"""The input and the solution of every solver, and pixels as readings on the devices."""
