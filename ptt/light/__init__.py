"""Distant light: an HDR map as a function on the sphere, and maps made ready for lookups."""
