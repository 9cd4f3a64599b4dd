"""Policies for programs without JAX, videos and figures, envs for other trainers."""
