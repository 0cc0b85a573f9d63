"""The planners: a robot's state, the planner's contract, and the policies of each phase (Section III)."""
