"""One run on disk: the loop, checkpoints, metrics, evaluations, progress and signals."""
