"""A trained policy plays in Gymnasium, from policy.npz beside this file: python agent.py --episodes 5"""

import argparse
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from dgae_jax.export.outside.policy import Policy


def make_world(policy: Policy) -> Any:
    """The task that the policy was trained on, with the same time limit."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that v4 is not the latest version is known
        return gymnasium.make(
            str(policy.arrays["env"]), max_episode_steps=int(policy.arrays["episode_length"])
        )


def play(world: Any, policy: Policy, number: int) -> float:
    """The undiscounted return of the episode that begins with the seed `number`."""
    obs, _ = world.reset(seed=number)
    total, is_over = 0.0, False
    while not is_over:
        obs, reward, terminated, truncated, _ = world.step(policy(obs))
        total, is_over = total + float(reward), terminated or truncated
    return total


def main() -> None:
    """Play, and print the returns."""
    parser = argparse.ArgumentParser(description="A trained policy plays in Gymnasium.")
    parser.add_argument("--episodes", type=int, default=5, help="episodes to play (default: 5)")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="decides the initial states, as in `dgae evaluate` (default: 0)",
    )
    arguments = parser.parse_args()
    if arguments.episodes < 1 or arguments.seed < 0:
        parser.error("--episodes must be at least 1 and --seed at least 0")
    policy = Policy(Path(__file__).with_name("policy.npz"))
    world, returns = make_world(policy), []
    for i in range(arguments.episodes):
        number = np.random.SeedSequence((arguments.seed, i)).generate_state(1, np.uint64)[0]
        returns.append(play(world, policy, int(number)))
        print(f"episode {i + 1}: return {returns[-1]:.4f}", flush=True)
    print(f"mean {np.mean(returns):.4f}, standard deviation {np.std(returns):.4f}")


if __name__ == "__main__":
    main()
