"""The names with which range and radio models are written: the contracts, and the shipped models."""

from __future__ import annotations

from world.radio_models import ByteRateRadio, CollidingRadio, FadingRadio, LogDistanceRadio, WalledRadio
from world.range_models import FadingRange, WalledRange
from world.world_models import Point, RadioModel, Radios, RangeModel, Transmission

__all__ = [
    "ByteRateRadio",
    "CollidingRadio",
    "FadingRadio",
    "FadingRange",
    "LogDistanceRadio",
    "Point",
    "RadioModel",
    "Radios",
    "RangeModel",
    "Transmission",
    "WalledRadio",
    "WalledRange",
]
