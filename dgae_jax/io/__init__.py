"""Where the library meets the machine: files, clock, terminal, Gymnasium."""
