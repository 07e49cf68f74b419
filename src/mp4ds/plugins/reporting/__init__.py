"""A dataset as a page for the browser, and its frames as images."""
