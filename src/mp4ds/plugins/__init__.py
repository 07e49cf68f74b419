"""What is built on the core, which knows none of it."""
