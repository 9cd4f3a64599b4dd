"""Play a trained policy in Gymnasium: python agent.py --episodes 5."""

import argparse
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from policy import Policy


def play(env: Any, policy: Policy, seed: int) -> float:
    """Return the undiscounted return of the episode that begins with this seed."""
    obs, _ = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        obs, reward, terminated, truncated, _ = env.step(policy(obs))
        total, done = total + float(reward), terminated or truncated
    return total


def main() -> None:
    """Play, and print the returns."""
    parser = argparse.ArgumentParser(description="Play a trained policy in Gymnasium.")
    parser.add_argument("--episodes", type=int, default=5, help="episodes to play (default: 5)")
    parser.add_argument("--seed", type=int, default=0, help="as in `dgae evaluate` (default: 0)")
    args = parser.parse_args()
    policy = Policy(Path(__file__).with_name("policy.npz"))
    warnings.simplefilter("ignore")  # a v4 task warns that it is not the latest version
    env = gymnasium.make(
        str(policy.arrays["env"]), max_episode_steps=int(policy.arrays["episode_length"])
    )
    returns = []
    for i in range(args.episodes):
        seed = np.random.SeedSequence((args.seed, i)).generate_state(1, np.uint64)[0]
        returns.append(play(env, policy, int(seed)))
        print(f"episode {i + 1}: return {returns[-1]:.4f}", flush=True)
    print(f"mean {np.mean(returns):.4f}, standard deviation {np.std(returns):.4f}")


if __name__ == "__main__":
    main()
