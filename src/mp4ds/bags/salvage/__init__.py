"""Readers of damaged recordings: they read what is left, and list what is lost."""
