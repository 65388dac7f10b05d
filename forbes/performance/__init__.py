"""Performance: faster forms of what is defined elsewhere. A first reading may skip all of it."""
