"""Settings of encoders, tried on clips of a recording."""
