"""Dataset -> recording, as recorded or with images in another form."""
