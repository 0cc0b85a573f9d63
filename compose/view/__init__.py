"""Scenes of a run for viewers: the page (`web`), MCAP files (`foxglove`) and exported files (`export`)."""
