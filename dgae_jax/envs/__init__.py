"""The tasks, as Brax environments: see `gym_tasks`, and `registry` for their names."""
