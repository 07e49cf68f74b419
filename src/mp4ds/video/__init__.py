"""Videos: codecs, packets, encoding, decoding, random access, scores. The home of PyAV."""
