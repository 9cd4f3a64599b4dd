"""One training iteration: networks, critics, updates, running scales, rollouts, and the step that joins them."""
