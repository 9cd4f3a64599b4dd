"""A trained policy leaves the house: files for programs without JAX, pictures and films of it."""
