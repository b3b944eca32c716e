"""The methods of `relit solve`, pass by pass."""
