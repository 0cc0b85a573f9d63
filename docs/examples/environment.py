"""Reinforcement learning in its simplest form: the best of some random policies in a room."""

from __future__ import annotations

import numpy as np

import tandem


def main(policies: int = 8, missions: int = 2) -> None:
    """Print the mean return of each policy that is better than all before it."""
    env = tandem.parallel_env("room")
    best, rng, limit = -np.inf, np.random.default_rng(1), env.action_space("a").high
    for number in range(policies):
        weights, returned = rng.normal(size=(2, 2)), 0.0
        for seed in range(missions):
            seen, _ = env.reset(seed=seed)
            while env.agents:  # empty once all have claimed their poses, or at max_ticks
                known = {robot: np.array((1.0, np.mean(one[7:] >= 0.0))) for robot, one in seen.items()}
                seen, rewards, *_ = env.step({one: limit * np.tanh(known[one] @ weights) for one in known})
                returned += rewards["a"] / missions
        if returned > best:
            best = returned
            print(f"policy {number}: {returned:.0f}")


if __name__ == "__main__":
    main()
