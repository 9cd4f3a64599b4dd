"""Many runs: which there are, who runs them, what came of them."""
