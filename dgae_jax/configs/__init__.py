"""Configurations of runs, as a user writes them and resolved; presets and checks.

Nothing here imports JAX, so that a command line is checked before JAX is loaded.
"""
