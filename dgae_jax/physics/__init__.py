"""Physics engines behind one contract; see `engine`."""
