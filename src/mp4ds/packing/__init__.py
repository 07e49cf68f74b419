"""Source -> dataset."""
