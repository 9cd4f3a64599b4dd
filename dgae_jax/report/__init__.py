"""Statistics, figures, tables and a page from the results of sweeps."""
