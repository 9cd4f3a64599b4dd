"""One run on disk: training loop, checkpoints, metrics, evaluation, fault tolerance."""
