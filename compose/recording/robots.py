"""Names that compose/figures uses until it reads a Run."""

from compose.recording.run import outcome as outcome  # noqa: PLC0414
