"""Sweeps of runs, and tunings of their hyperparameters."""
