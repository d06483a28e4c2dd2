"""Geometry in named regions, what it is made of, and the camera that looks at it."""
