"""The contents of camera messages: serializations, image encodings and layouts, image files."""
