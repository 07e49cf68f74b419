"""Readers of damaged recordings: they give what is there, and list what is lost."""
