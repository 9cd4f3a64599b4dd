"""What a run is: the configuration as a user writes it, the resolved one, presets and their checks.

Nothing here imports JAX, so that a command line is checked before JAX is loaded.
"""
