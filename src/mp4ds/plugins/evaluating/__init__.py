"""Compares encoder settings on clips of a recording."""
