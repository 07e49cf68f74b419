"""Dataset -> the formats of other tools."""
