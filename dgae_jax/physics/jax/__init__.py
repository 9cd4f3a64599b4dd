"""MuJoCo's stages in our own JAX code, named as in MJX; the env axis N is the last."""
