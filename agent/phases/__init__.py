"""The paper's three phases: the states of each, and what ends them."""
