"""Viewers of other people that a run feeds while it trains: TensorBoard, Weights & Biases, MLflow."""
