"""Programs that are copied beside an exported policy and run where nothing of dgae_jax is installed."""
