"""What camera messages hold: serializations, image encodings and layouts, files of images."""
