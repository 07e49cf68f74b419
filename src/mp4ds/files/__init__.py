"""Where recordings and datasets are: outputs, sources, and what is at URLs."""
