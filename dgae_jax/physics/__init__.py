"""Physics engines behind one contract: see `base`."""
