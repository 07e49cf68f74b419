"""Where recordings and datasets are: outputs, sources, and URLs."""
