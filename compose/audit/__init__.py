"""The judge: what a run's journals say, held against the scenario, the world and the planner."""
