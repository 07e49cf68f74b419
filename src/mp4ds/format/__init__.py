"""The format of sidecars and manifests: models, files, and older versions (spec/index.md)."""
