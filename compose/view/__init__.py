"""Scenes of a run for viewers: the page (`web`), Foxglove (`foxglove`) and exported files (`export`)."""
