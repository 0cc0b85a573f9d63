"""The hunt: a search for inputs of a mission with which an invariant does not hold."""
