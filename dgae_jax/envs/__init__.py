"""The tasks, as Brax environments: `task` is what they share, `gym_tasks` the four of Gymnasium."""
