"""What is built on the core, which does not depend on it."""
