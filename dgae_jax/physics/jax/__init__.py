"""MuJoCo's stages in JAX, our own: the world is the last axis of every array."""
