"""A trained policy leaves the house: pictures and films of it."""
