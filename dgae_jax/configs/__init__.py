"""What a run is: its configuration, the table of algorithms, presets, what is allowed, and how it is built."""
