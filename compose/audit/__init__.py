"""The audit: rules that recompute a run from its recording."""
